"""Driver of a Universal Robots arm through ``ur_rtde``."""
