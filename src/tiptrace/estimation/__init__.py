"""Estimators: anchoring, motion, propagation. They see markers and poses, never images."""
