"""Pre-grasps predicted from an object's shape.

The object is encoded by its distances from fixed points around it, the hand by a vector relative to
the object. A Gaussian over these vectors has a mean that is linear in the distances.
"""
