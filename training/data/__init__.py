"""Labelled recordings and simulated contacts as data sets."""
