"""The package as others meet it: its metadata, its layers, its launch file, its colcon build."""

import ast
import os
import re
import runpy
import shutil
import subprocess
import sys
import tomllib
import typing
import xml.etree.ElementTree as ET
from pathlib import Path
from unittest.mock import MagicMock

import pytest

import cloth_predict
from cloth_predict.config import ReplayConfig
from cloth_predict.config.ruler_video import VideoConfig

ROOT = Path(__file__).parents[1]
LAUNCHED = {'mocap_replay_node', 'ekf_node', 'projector_node'}
NODES = {*LAUNCHED, 'rest_node', 'video_node', 'ruler_node'}


# --- metadata


@pytest.fixture
def setup_arguments(monkeypatch):
    """What setup.py passes to setup(), without setuptools, which an environment may lack."""
    setuptools = MagicMock()
    monkeypatch.setitem(sys.modules, 'setuptools', setuptools)
    monkeypatch.chdir(ROOT)
    runpy.run_path('setup.py')
    return setuptools.setup.call_args.kwargs


@pytest.fixture(scope='module')
def manifest():
    return ET.parse(ROOT / 'package.xml').getroot()


def test_name_version_and_licence_agree(setup_arguments, manifest):
    for key in ('name', 'version', 'license', 'description'):
        assert manifest.findtext(key) == setup_arguments[key], key
    assert setup_arguments['name'] == cloth_predict.__name__
    assert setup_arguments['version'] == cloth_predict.__version__


def test_package_xml_is_an_ament_python_package(manifest):
    assert manifest.get('format') == '3'
    assert manifest.findtext('export/build_type') == 'ament_python'
    assert manifest.findtext('test_depend') == 'python3-pytest'


def test_package_xml_lists_every_ros_package_that_is_imported(manifest):
    depends = {element.text for element in manifest.findall('exec_depend')}
    files = [*ROOT.glob('cloth_predict/nodes/*.py'), *ROOT.glob('launch/*.py')]
    imported = {name.split('.')[0] for file in files for name in imports(file.read_text())}
    assert {name for name in imported if is_ros(name) or name.startswith('launch')} <= depends


def test_console_scripts_exist(setup_arguments):
    scripts = dict(
        script.split(' = ') for script in setup_arguments['entry_points']['console_scripts']
    )
    assert set(scripts) == {'cloth-predict', *NODES}
    for target in scripts.values():
        module, function = target.split(':')
        source = (ROOT / module.replace('.', '/')).with_suffix('.py').read_text()
        functions = {n.name for n in ast.parse(source).body if isinstance(n, ast.FunctionDef)}
        assert function in functions, target


def test_data_files_exist_once_each(setup_arguments):
    listed = [file for _, files in setup_arguments['data_files'] for file in files]
    assert all((ROOT / file).is_file() for file in listed)
    assert len(set(listed)) == len(listed)
    assert {'resource/cloth_predict', 'package.xml', 'config/towel.yaml'} <= set(listed)
    assert {str(f.relative_to(ROOT)) for f in ROOT.glob('bags/**/*') if f.is_file()} <= set(listed)


def test_linter_bans_every_ros_package_that_is_a_dependency(manifest):
    depends = {element.text for element in manifest.findall('exec_depend')}
    lint = tomllib.loads((ROOT / 'pyproject.toml').read_text())['tool']['ruff']['lint']
    banned = set(lint['flake8-tidy-imports']['banned-api'])
    assert {name for name in depends if is_ros(name)} <= banned


# --- layers: types <- models, integrators, observations <- filters <- surface, markers <- tracking
# <- bodies <- tracker <- {evaluation, cli, nodes}

ONLY = {
    'types': {'types', 'errors'},
    'errors': {'types', 'errors'},
    'config': {'types', 'errors', 'config'},
    'models': {'types', 'errors', 'models'},
    'integrators': {'types', 'errors', 'models', 'integrators'},
    'observations': {'types', 'errors', 'models'},
}
ABOVE = {'identification', 'experiments'}
TRACKING = {'tracking', 'bodies', 'tracker'}
NEVER = {
    'filters': {
        'surface',
        'markers',
        'tracking',
        'bodies',
        'tracker',
        'evaluation',
        *ABOVE,
        'cli',
        'command_line',
        'nodes',
    },
    'surface': {*TRACKING, 'evaluation', *ABOVE, 'cli', 'command_line', 'nodes'},
    'markers': {*TRACKING, 'evaluation', *ABOVE, 'cli', 'command_line', 'nodes'},
    'tracking': {
        'bodies',
        'tracker',
        'evaluation',
        *ABOVE,
        'cli',
        'command_line',
        'nodes',
        'formats',
    },
    'bodies': {'tracker', 'evaluation', *ABOVE, 'cli', 'command_line', 'nodes', 'formats'},
    'tracker': {'evaluation', *ABOVE, 'cli', 'command_line', 'nodes', 'formats'},
    'evaluation': {*ABOVE, 'cli', 'command_line', 'nodes'},
    'identification': {'experiments', 'cli', 'command_line', 'nodes'},
    'simulation': {
        'filters',
        'markers',
        *TRACKING,
        *ABOVE,
        'evaluation',
        'cli',
        'command_line',
        'nodes',
    },
    'cli': {'cli'},
    'command_line': {'cli', 'nodes'},
    'nodes': {'cli', 'command_line'},
}


def imports(source):
    """Every module that the source imports, `from a import b` as a.b, wherever it stands."""
    names = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names += [f'{"." * node.level}{node.module}.{alias.name}' for alias in node.names]
    return names


def is_ros(module):
    return re.match(r'(rclpy|std_srvs|builtin_interfaces|\w+_msgs)(\.|$)', module) is not None


def may_import(part, name):
    """Whether `part`, a module or folder of cloth_predict, may import the module `name`."""
    if not name.startswith('cloth_predict.'):
        return not name.startswith('.') and (part == 'nodes' or not is_ros(name))
    target = name.split('.')[1]
    if part in ONLY:
        return target in ONLY[part]
    return target not in NEVER.get(part, {'cli', 'command_line', 'nodes'})


MODULES = sorted(
    path.relative_to(ROOT / 'cloth_predict') for path in ROOT.glob('cloth_predict/**/*.py')
)


@pytest.mark.parametrize('module', MODULES, ids=str)
def test_imports_point_one_way(module):
    source = (ROOT / 'cloth_predict' / module).read_text()
    part = module.parts[0].removesuffix('.py')
    assert [name for name in imports(source) if not may_import(part, name)] == []


@pytest.mark.parametrize(
    ('part', 'source'),
    [
        ('types', 'import cloth_predict.models.mass_spring'),
        ('config', 'from cloth_predict import tracker'),
        ('models', 'from cloth_predict.filters.ekf import ExtendedKalmanFilter'),
        ('observations', 'def f():\n    from cloth_predict.tracker import Tracker'),
        ('filters', 'from cloth_predict.tracker import Tracker'),
        ('tracker', 'from cloth_predict.formats.bag import read'),
        ('simulate', 'import cloth_predict.cli'),
        ('nodes', 'from cloth_predict.cli import main'),
        ('formats', 'from sensor_msgs.msg import PointCloud2'),
        ('tracker', 'if True:\n    import rclpy.node as node'),
        ('filters', 'from .linear import condition'),
    ],
)
def test_a_wrong_import_is_found(part, source):
    assert [may_import(part, name) for name in imports(source)] == [False]


# --- launch files


@pytest.fixture
def launch(monkeypatch):
    """Run a launch file on stand-ins for launch: (default of each argument, started nodes)."""
    parts = '', '.actions', '.substitutions', '.parameter_descriptions'
    fake = {top + part: MagicMock() for top in ('launch', 'launch_ros') for part in parts}
    for name, module in fake.items():
        monkeypatch.setitem(sys.modules, name, module)
    substitutions = fake['launch.substitutions']
    substitutions.LaunchConfiguration.side_effect = '${{{}}}'.format
    substitutions.PathJoinSubstitution.side_effect = '/'.join
    fake['launch_ros.substitutions'].FindPackageShare.side_effect = 'share of {}'.format
    fake['launch_ros.parameter_descriptions'].ParameterValue.side_effect = (
        lambda value, value_type: (value, value_type)
    )

    def run(name):
        runpy.run_path(str(ROOT / 'launch' / name))['generate_launch_description']()
        actions = fake['launch.actions'].DeclareLaunchArgument.call_args_list
        arguments = {call.args[0]: call.kwargs.get('default_value') for call in actions}
        calls = fake['launch_ros.actions'].Node.call_args_list
        return arguments, {call.kwargs['executable']: call.kwargs for call in calls}

    return run


@pytest.fixture
def launched(launch):
    return launch('predict.launch.py')


@pytest.mark.parametrize('name', sorted(path.name for path in ROOT.glob('launch/*.py')))
def test_launched_nodes_exist_and_use_declared_arguments(launch, name):
    arguments, nodes = launch(name)
    assert set(nodes) <= NODES
    for node in nodes.values():
        assert node['package'] == 'cloth_predict'
        assert node['namespace'] == '${namespace}'
        assert node['parameters'][0] == '${config}'
        assert set(re.findall(r'\$\{(\w+)\}', str(node['parameters']))) <= set(arguments)


def test_the_video_is_launched_with_its_parameters(launch):
    arguments, nodes = launch('ruler.launch.py')
    assert arguments == {'video': None, 'config': None, 'speed': '1.0', 'namespace': ''}
    assert set(nodes) == {'video_node', 'ruler_node'}
    kinds = typing.get_type_hints(VideoConfig)
    assert nodes['video_node']['parameters'][1] == {
        'video.path': ('${video}', kinds['path']),
        'video.speed': ('${speed}', kinds['speed']),
    }


def test_launch_arguments_default_to_what_the_package_brings(launched):
    arguments, _ = launched
    replay = ReplayConfig()
    assert arguments == {
        'config': 'share of cloth_predict/config/towel.yaml',
        'bag': 'share of cloth_predict/bags/towel_fan',
        'rate': str(replay.rate),
        'loop': str(replay.loop).lower(),
        'namespace': '',
        'use_sim_time': 'true',
    }
    assert (ROOT / 'config/towel.yaml').is_file()
    assert (ROOT / 'bags/towel_fan').exists()


def test_launch_starts_the_three_nodes(launched):
    assert set(launched[1]) == LAUNCHED


def test_launch_parameters_exist_with_their_types(launched):
    _, nodes = launched
    replay = dict(nodes['mocap_replay_node']['parameters'][1])
    assert replay.pop('use_sim_time') is False, 'the node that publishes /clock cannot follow it'
    kinds = typing.get_type_hints(ReplayConfig)
    assert replay == {
        'replay.path': ('${bag}', kinds['path']),
        'replay.rate': ('${rate}', kinds['rate']),
        'replay.loop': ('${loop}', kinds['loop']),
    }
    for name in ('ekf_node', 'projector_node'):
        assert nodes[name]['parameters'][1:] == [{'use_sim_time': ('${use_sim_time}', bool)}]


# --- colcon


@pytest.fixture(scope='module')
def installed(tmp_path_factory):
    """The install folder of a colcon build of a copy of this tree."""
    own = ROOT / '.venv-colcon/bin/colcon'
    colcon = str(own) if own.exists() else shutil.which('colcon')
    if colcon is None:
        pytest.skip('no colcon: neither .venv-colcon (make test sets it up) nor one on PATH')
    workspace = tmp_path_factory.mktemp('workspace')
    leave = shutil.ignore_patterns(
        '.*', '__pycache__', '*.egg-info', 'build', 'install', 'log', 'out'
    )
    shutil.copytree(ROOT, workspace / 'src/cloth_predict', ignore=leave)
    command = [colcon, 'build', '--event-handlers', 'console_direct+']
    done = subprocess.run(command, cwd=workspace, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    return workspace / 'install/cloth_predict'


@pytest.mark.parametrize('script', [*sorted(NODES), 'cloth-predict'])
def test_colcon_installs_scripts_where_ros2_run_looks(installed, script):
    path = installed / 'lib/cloth_predict' / script
    assert path.read_text().splitlines()[0] == '#!/usr/bin/env python3'
    assert os.access(path, os.X_OK)


def test_colcon_installs_the_share_folder(installed):
    share = installed / 'share/cloth_predict'
    assert (installed / 'share/ament_index/resource_index/packages/cloth_predict').is_file()
    sources = [ROOT / 'package.xml', *ROOT.glob('launch/*.py')]
    sources += [*ROOT.glob('config/*.yaml'), *(f for f in ROOT.glob('bags/**/*') if f.is_file())]
    for source in sources:
        assert (share / source.relative_to(ROOT)).read_bytes() == source.read_bytes()


def test_colcon_installs_every_module(installed):
    (package,) = installed.glob('lib/python3*/site-packages/cloth_predict')
    found = sorted(path.relative_to(package) for path in package.glob('**/*.py'))
    assert found == MODULES
