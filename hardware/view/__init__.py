"""What a live session shows: the frame with pins, graph and Voronoi map, the pose and the rates, in a window or a browser."""
