"""A session with real cameras and a real robot: the loop, the recorder, the phases, the health of it all."""
