"""How close rendered frames come to real ones: pictures pair by pair, and the statistics of both."""
