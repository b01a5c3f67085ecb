"""Pre-grasps predicted from an object's shape.

The object is encoded as its distances from fixed points around it, the hand's pose relative to the
object as a grasp vector. Grasp vectors are modelled by a Gaussian whose mean is linear in the
distances.
"""
