"""Rigid transforms, point-set alignment and fixed points: pure functions on arrays."""
