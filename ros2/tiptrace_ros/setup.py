"""Makes `ros2 run tiptrace_ros tiptrace_node` and `ros2 launch tiptrace_ros tiptrace.launch.py` find the node."""

from setuptools import setup

NAME = "tiptrace_ros"

setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/tiptrace.launch.py"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    maintainer="The tiptrace developers",
    maintainer_email="tiptrace@users.noreply.github.com",
    description="Where a grasped tool touches the world, as a ROS 2 node",
    license="Apache-2.0",
    entry_points={"console_scripts": [f"tiptrace_node = {NAME}.node:main"]},
)
