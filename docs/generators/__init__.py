"""What the documentation generates from the code: references of commands, specifications and functions, and notebooks."""
