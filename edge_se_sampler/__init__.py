"""Pixel samplers for NeRF training: Random, Precrop, Edge and squared error."""

__version__ = "0.1.0"
