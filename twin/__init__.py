"""The TacTip twin: press a skin, render what the camera inside sees, find the pins, build the graph."""
