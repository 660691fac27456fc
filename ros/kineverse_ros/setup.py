"""Package for a colcon workspace, and for pip; what it needs of ROS 2 is in package.xml."""

from glob import glob

from setuptools import setup

NAME = "kineverse_ros"

README = """\
Adds `kineverse ros` to `kineverse-articulation`: any articulation model as TF, joint states and markers, in
place of robot_state_publisher or beside it; and robots behind topics, for skills that move them.

It needs an installation of ROS 2, which pip does not install: rclpy, tf2_msgs and the messages that
`package.xml` lists.
"""

setup(
    name=NAME,
    version="0.1.0",
    description="ROS 2 nodes of Kineverse: any articulation model as TF, joint states and markers.",
    long_description=README,
    long_description_content_type="text/markdown",
    author="The Kineverse developers",
    license="Apache-2.0",
    license_files=["LICENSE"],
    keywords=["robotics", "ros", "kinematics", "articulation", "tf"],
    classifiers=[
        "Development Status :: 3 - Alpha",
        "Intended Audience :: Developers",
        "Intended Audience :: Science/Research",
        "Operating System :: POSIX :: Linux",
        "Programming Language :: Python :: 3",
        "Programming Language :: Python :: 3 :: Only",
        "Programming Language :: Python :: 3.11",
        "Programming Language :: Python :: 3.12",
        "Programming Language :: Python :: 3.13",
        "Programming Language :: Python :: 3.14",
        "Topic :: Scientific/Engineering",
        "Typing :: Typed",
    ],
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
