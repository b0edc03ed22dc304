"""The virtual rig. It never imports perception or estimation, or it would share their mistakes."""
