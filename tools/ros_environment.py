"""Complete an environment of ROS 2 wheels: ``.venv/ros/bin/python tools/ros_environment.py PYTHON``.

What the wheels lack is made in the environment of this interpreter: the package ``tf2_msgs``, from its
definition, by cmake and a C++ compiler, and a way to the packages of Kineverse's environment, that of PYTHON.
"""

from __future__ import annotations

import os
import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path

BUILT_WITH = (
    "/opt/python/cp311-cp311/"  # prefix of the Python that the wheels were built with, in their files
)

PACKAGE = """\
<?xml version="1.0"?>
<package format="3">
  <name>tf2_msgs</name>
  <version>0.0.0</version>
  <description>Message of transforms.</description>
  <maintainer email="nobody@example.com">nobody</maintainer>
  <license>Apache-2.0</license>
  <buildtool_depend>ament_cmake</buildtool_depend>
  <depend>geometry_msgs</depend>
  <member_of_group>rosidl_interface_packages</member_of_group>
</package>
"""

BUILD = """\
cmake_minimum_required(VERSION 3.20)
project(tf2_msgs C CXX)
find_package(ament_cmake REQUIRED)
find_package(geometry_msgs REQUIRED)
find_package(rosidl_default_generators REQUIRED)
rosidl_generate_interfaces(${PROJECT_NAME} "msg/TFMessage.msg" DEPENDENCIES geometry_msgs)
ament_package()
"""

MESSAGE = "geometry_msgs/TransformStamped[] transforms\n"


def make_tf2_msgs(prefix: Path) -> None:
    """Generate, compile and install the package into an environment."""
    for path in (prefix / "share").rglob("*.cmake"):
        text = path.read_text("utf-8")
        if BUILT_WITH in text:
            path.write_text(text.replace(BUILT_WITH, f"{sys.base_prefix}/"), "utf-8")
    variables = {**os.environ, "PATH": f"{prefix / 'bin'}{os.pathsep}{os.environ['PATH']}"}
    with tempfile.TemporaryDirectory() as folder:
        source, build = Path(folder, "tf2_msgs"), Path(folder, "build")
        (source / "msg").mkdir(parents=True)
        (source / "package.xml").write_text(PACKAGE, "utf-8")
        (source / "CMakeLists.txt").write_text(BUILD, "utf-8")
        (source / "msg" / "TFMessage.msg").write_text(MESSAGE, "utf-8")
        settings = {
            "CMAKE_BUILD_TYPE": "Release",
            "CMAKE_INSTALL_PREFIX": prefix,
            "CMAKE_PREFIX_PATH": prefix,
            "Python3_EXECUTABLE": prefix / "bin" / "python",
            "BUILD_TESTING": "OFF",
        }
        options = [f"-D{name}={value}" for name, value in settings.items()]
        for command in (
            ["cmake", "-S", source, "-B", build, *options],
            ["cmake", "--build", build, "--parallel", "2", "--target", "install"],
        ):
            done = subprocess.run(
                command,
                env=variables,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                encoding="utf-8",
            )
            if done.returncode:
                sys.exit(f"{done.stdout}\ntf2_msgs cannot be made.")


def link_packages(python: str) -> None:
    """Have this environment import the packages of another one, behind its own."""
    show = "import sysconfig; print(sysconfig.get_path('purelib'))"
    other = subprocess.run(
        [python, "-c", show], capture_output=True, text=True, encoding="utf-8", check=True
    ).stdout.strip()
    own = Path(sysconfig.get_path("purelib"))
    # The folder and what its own .pth files name, such as editable installations.
    (own / "zz_kineverse.pth").write_text(f"import site; site.addsitedir({other!r})\n", "utf-8")


if __name__ == "__main__":
    link_packages(sys.argv[1])  # numpy among them
    make_tf2_msgs(Path(sys.prefix))
