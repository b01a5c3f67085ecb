"""Pre-grasps predicted from an object's shape.

An object is encoded as the distances of its surface from fixed points around it. A hand's pose
relative to the object is converted to a grasp vector. Grasp vectors are modelled by a Gaussian
whose mean is linear in the distances.
"""
