"""Parts of another package, one of each kind."""
