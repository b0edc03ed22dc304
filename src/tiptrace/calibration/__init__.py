"""What a user measures once: gel, rig, tip."""
