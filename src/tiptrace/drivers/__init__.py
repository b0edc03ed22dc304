"""Cameras and robots: each delivers samples on one monotonic timeline and says what it is worth."""
