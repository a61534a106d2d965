"""A rig: camera, arm and object, and the ways between their poses."""
