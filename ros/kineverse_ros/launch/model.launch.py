"""Launch of the model node: ``ros2 launch kineverse_ros model.launch.py model:=kitchen rate:=100.0``."""

from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from kineverse_ros.model_settings import SETTINGS
from launch import LaunchDescription


def generate_launch_description() -> LaunchDescription:
    arguments = [DeclareLaunchArgument("use_sim_time", default_value="false", description="time of /clock")]
    parameters = {"use_sim_time": ParameterValue(LaunchConfiguration("use_sim_time"), value_type=bool)}
    for name, setting in SETTINGS.items():
        default = setting.default
        # Several texts are the words of one.
        text = " ".join(default) if isinstance(default, list) else str(default)
        required = {} if name == "model" else {"default_value": text}
        arguments.append(DeclareLaunchArgument(name, description=setting.help, **required))
        kind = float if isinstance(default, float) else str
        parameters[name] = ParameterValue(LaunchConfiguration(name), value_type=kind)
    node = Node(
        package="kineverse_ros",
        executable="model_node",
        name="kineverse_model",
        output="screen",
        parameters=[parameters],
    )
    return LaunchDescription([*arguments, node])
