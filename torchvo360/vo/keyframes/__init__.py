"""Keyframes, their points, and the window that adjusts them."""
