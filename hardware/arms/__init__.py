"""Robot arms behind one protocol."""
