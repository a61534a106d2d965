"""Pictures for people: the skin in 3D, pins and graphs over a frame, Voronoi maps, a page."""
