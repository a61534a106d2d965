"""The soft body: its elements, their law, and its stiffness."""
