"""Pre-grasps predicted from an object's shape.

An object becomes its distances from fixed points around it, a hand a vector of numbers relative to
the object; between them stands a Gaussian whose mean depends linearly on the distances.
"""
