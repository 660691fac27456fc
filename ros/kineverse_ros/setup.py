"""Package for a colcon workspace, and for pip; what it needs of ROS 2 is in package.xml."""

from glob import glob

from setuptools import setup

NAME = "kineverse_ros"

setup(
    name=NAME,
    version="0.1.0",
    description="ROS 2 nodes of Kineverse: any articulation model as TF, joint states and markers.",
    author="The Kineverse developers",
    license="Apache-2.0",
    python_requires=">=3.11",
    packages=[NAME],
    package_dir={
        "": "."
    },  # so an editable installation is a line in a .pth file, and costs no import at start
    package_data={NAME: ["py.typed"]},
    install_requires=["kineverse-articulation==0.1.0"],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", sorted(glob("launch/*.launch.py"))),
    ],
    entry_points={
        "console_scripts": [f"model_node = {NAME}.model_node:main"],
        "kineverse.commands": [f"ros = {NAME}.command"],
        "kineverse.robots": [f"ros = {NAME}.ros_robot:RosRobot"],
    },
)
