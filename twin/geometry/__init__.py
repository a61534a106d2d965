"""The undeformed sensor: skin, gel, window and pins as meshes and places."""
