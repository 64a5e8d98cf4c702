"""Play a video of a sliding bar and follow the bar: the video node and the ruler node."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

PACKAGE = 'cloth_predict'


def generate_launch_description():
    """Declare the arguments and start the nodes."""
    play = {'video.path': _typed('video', str), 'video.speed': _typed('speed', float)}
    return LaunchDescription(
        [
            DeclareLaunchArgument('video', description='MP4 file or folder of numbered PNG files'),
            DeclareLaunchArgument('config', description='parameter file of both nodes'),
            DeclareLaunchArgument('speed', default_value='1.0', description='speed of replay'),
            DeclareLaunchArgument('namespace', default_value='', description='of both nodes'),
            _node('video_node', [play]),
            _node('ruler_node', []),
        ]
    )


def _typed(argument, kind):
    """Convert an argument's text: `1` for a double would otherwise become an integer."""
    return ParameterValue(LaunchConfiguration(argument), value_type=kind)


def _node(executable, own):
    return Node(
        package=PACKAGE,
        executable=executable,
        namespace=LaunchConfiguration('namespace'),
        parameters=[LaunchConfiguration('config'), *own],
        output='screen',
    )
