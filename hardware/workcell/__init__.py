"""A workcell: camera, arm and object together, the check of a plan, and the one way in which an arm moves to and from the object."""
