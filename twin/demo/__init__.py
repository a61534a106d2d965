"""The main job from end to end on shipped specifications, as pictures and one page."""
