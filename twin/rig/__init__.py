"""A sensor on an arm before an object: labels, kinematics, mounting, touch, and the one contact model that all of these share."""
