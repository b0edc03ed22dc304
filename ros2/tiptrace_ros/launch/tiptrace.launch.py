"""ros2 launch tiptrace_ros tiptrace.launch.py rig:=/path/to/rig.yaml [use_sim_time:=true] [map:=map.yaml] …"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

ARGUMENTS = {  # name: (default, type, what it is)
    "rig": (None, str, "rig.yaml, with reference_left.png and reference_right.png beside it"),
    "tool": ("", str, "tool.yaml; default: the one beside the rig file"),
    "map": ("", str, "map.yaml: topics, crop and size of another set-up"),
    "method": ("full", str, "full, paper, or a baseline"),
    "left_topic": ("", str, "CompressedImage where the name ends in 'compressed', else Image"),
    "right_topic": ("", str, "the other finger"),
    "pose_topic": ("", str, "PoseStamped; default /ee_pose"),
    "use_tf": ("false", bool, "take the pose from TF in place of the topic"),
    "end_effector_frame": ("", str, "for TF; default: frames.end_effector of the rig file"),
    "phase_topic": ("", str, "String; default /trial/phase"),
    "opening_topic": ("", str, "Float64; default /gripper/opening"),
    "reliable": ("false", bool, "ask for reliable delivery"),
    "queue_depth": ("10", int, "messages that each subscription holds"),
    "wait_for_late_s": (
        "0.0",
        float,
        "0 for live use; 0.25 waits for late samples, for bags",
    ),
    "path_length": ("5000", int, "poses that the path keeps"),
    "use_sim_time": ("false", bool, "take the time from /clock (ros2 bag play --clock)"),
}


def generate_launch_description() -> LaunchDescription:
    """One node, every parameter an argument."""
    arguments = [
        DeclareLaunchArgument(
            name, description=what, **({} if default is None else {"default_value": default})
        )
        for name, (default, _, what) in ARGUMENTS.items()
    ]
    parameters = {
        name: ParameterValue(LaunchConfiguration(name), value_type=kind)
        for name, (_, kind, _) in ARGUMENTS.items()
    }
    node = Node(
        package="tiptrace_ros",
        executable="tiptrace_node",
        name="tiptrace",
        output="screen",
        parameters=[parameters],
    )
    return LaunchDescription([*arguments, node])
