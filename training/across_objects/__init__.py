"""A model trained on some objects, judged on others."""
