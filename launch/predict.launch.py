"""Replay a bag, predict its surface and project it: the three nodes under the bag's clock."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

PACKAGE = 'cloth_predict'


def generate_launch_description():
    """Declare the arguments and start the nodes."""
    share = FindPackageShare(PACKAGE)
    config = PathJoinSubstitution([share, 'config', 'towel.yaml'])
    bag = PathJoinSubstitution([share, 'bags', 'towel_fan'])
    # The replay publishes /clock, so it cannot follow it.
    replay = {
        'use_sim_time': False,
        'replay.path': _typed('bag', str),
        'replay.rate': _typed('rate', float),
        'replay.loop': _typed('loop', bool),
    }
    follow = {'use_sim_time': _typed('use_sim_time', bool)}
    return LaunchDescription(
        [
            _argument('config', config, 'parameter file of all nodes'),
            _argument('bag', bag, 'bag (folder or .mcap) or Motive .csv to replay'),
            _argument('rate', '1.0', 'speed of replay'),
            _argument('loop', 'false', 'start again at the end'),
            _argument('namespace', '', 'namespace of all nodes'),
            _argument(
                'use_sim_time', 'true', 'predict and project under the /clock of the replay'
            ),
            _node('mocap_replay_node', replay),
            _node('ekf_node', follow),
            _node('projector_node', follow),
        ]
    )


def _argument(name, default, description):
    return DeclareLaunchArgument(name, default_value=default, description=description)


def _typed(argument, kind):
    """Convert an argument's text: `1` for a double would otherwise become an integer."""
    return ParameterValue(LaunchConfiguration(argument), value_type=kind)


def _node(executable, parameters):
    return Node(
        package=PACKAGE,
        executable=executable,
        namespace=LaunchConfiguration('namespace'),
        parameters=[LaunchConfiguration('config'), parameters],
        output='screen',
    )
