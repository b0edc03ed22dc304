"""tiptrace: where a grasped tool touches the world.

Reconstructs the trajectory of a tool's tip in the robot base frame from two tactile image streams and the
end-effector pose.
"""

__version__ = "0.1.0"
