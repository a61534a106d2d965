"""Digital twin of the TacTip: simulate contacts of the skin, render the frames of its camera, find the pins, and build their graph."""
