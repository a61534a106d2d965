"""The modes of the studio: each is one class with its controls."""
