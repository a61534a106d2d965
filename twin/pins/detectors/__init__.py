"""Methods of pin detection other than the pipeline's own, and their tuning."""
