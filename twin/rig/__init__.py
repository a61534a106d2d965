"""A sensor on an arm in front of an object: labels, kinematics, mounting, touch, and the contact model that all parts share."""
