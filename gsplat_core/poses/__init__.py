"""Camera poses of a moving scope, estimated from its pictures: odometry, bundle adjustment, focal length and breathing tissue.

`se3` has rigid motions, pose corrections and rolling shutters for training loops.
"""
