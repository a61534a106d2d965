"""The undeformed sensor: meshes of skin and gel, and positions of skin, window and pins."""
