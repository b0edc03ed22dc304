"""Where samples come from: recordings, the virtual rig, hardware; and how they are paired."""
