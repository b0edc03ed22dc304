"""Training data: the tip at the frames of a recording, for others' tools."""
