"""Start beacon_node: ``ros2 launch beacon_comm beacon.launch.py events:=/event_camera/events``."""

from launch.action import Action
from launch.actions import DeclareLaunchArgument, OpaqueFunction, SetEnvironmentVariable
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from launch import LaunchContext, LaunchDescription


def config_file(name: str) -> PathJoinSubstitution:
    """Return a file of the package's config folder."""
    return PathJoinSubstitution([FindPackageShare('beacon_comm'), 'config', name])


def start_node(context: LaunchContext) -> list[Action]:
    """Return the actions, now that the arguments have values."""
    argument = {
        name: LaunchConfiguration(name).perform(context)
        for name in ('events', 'camera_info', 'namespace', 'params_file', 'camera_info_file', 'use_sim_time',
                     'fastdds_profile')
    }
    parameters = [argument['params_file'], {'use_sim_time': argument['use_sim_time'].lower() == 'true'}]
    if argument['camera_info_file']:  # an empty one must not replace the parameter file's
        parameters.append({'camera_info_file': argument['camera_info_file']})
    node = Node(
        package='beacon_comm',
        executable='beacon_node',
        name='beacon_node',
        namespace=argument['namespace'],
        remappings=[('events', argument['events']), ('camera_info', argument['camera_info'])],
        parameters=parameters,
        output='screen',
    )
    if not argument['fastdds_profile']:
        return [node]
    return [SetEnvironmentVariable('FASTRTPS_DEFAULT_PROFILES_FILE', argument['fastdds_profile']), node]


def generate_launch_description() -> LaunchDescription:
    """Return the arguments and the node."""
    return LaunchDescription([
        DeclareLaunchArgument(
            'events', default_value='/event_camera/events', description='topic of the event camera driver'
        ),
        DeclareLaunchArgument(
            'camera_info', default_value='/event_camera/camera_info',
            description='topic of the calibration, read with use_camera_info: true',
        ),
        DeclareLaunchArgument('namespace', default_value='', description='namespace of the node'),
        DeclareLaunchArgument(
            'params_file', default_value=config_file('beacon.yaml'), description='parameters of the node'
        ),
        DeclareLaunchArgument(
            'camera_info_file', default_value='',
            description='calibration YAML: a path, a file:// or a package:// URL; empty: the parameter file decides',
        ),
        DeclareLaunchArgument('use_sim_time', default_value='false', description='take the time from /clock'),
        DeclareLaunchArgument(
            'fastdds_profile', default_value=config_file('fastdds_shm.xml'),
            description='Fast DDS profile with room for large messages, wanted in the driver, too; empty: none',
        ),
        OpaqueFunction(function=start_node),
    ])
