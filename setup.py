"""Installs with pip, and builds as a ROS 2 package with colcon."""

import re
from collections import defaultdict
from pathlib import Path

from setuptools import find_packages, setup

NAME = 'cloth_predict'
SHARE = Path('share', NAME)
SEARCHES = ['cma>=3.3', 'optuna>=4.0']
VIDEO = 'opencv-python-headless>=4.6'
VERSION = re.findall(r"^__version__ = '(.+)'$", Path(NAME, '__init__.py').read_text(), re.M)[0]


def data_files():
    """List (installed folder, files) for everything that ROS looks up in the share folder."""
    folders = defaultdict(list)
    folders['share/ament_index/resource_index/packages'] = [f'resource/{NAME}']
    folders[str(SHARE)] = ['package.xml']
    for top, pattern in (('config', '*.yaml'), ('launch', '*.py'), ('bags', '**/*')):
        for path in sorted(Path(top).glob(pattern)):
            if path.is_file():
                folders[str(SHARE / path.parent)].append(str(path))
    return list(folders.items())


setup(
    name=NAME,
    version=VERSION,
    description=(
        'Live prediction of deforming surfaces for projection: where a moving surface will be.'
    ),
    author='cloth_predict developers',
    author_email='cloth_predict@example.com',
    maintainer='cloth_predict developers',
    maintainer_email='cloth_predict@example.com',
    license='Apache-2.0',
    packages=find_packages(include=[NAME, f'{NAME}.*']),
    data_files=data_files(),
    zip_safe=False,
    python_requires='>=3.11',
    # numpy, scipy, matplotlib, ruamel.yaml, tqdm: no newer than what Ubuntu 24.04 (Jazzy) has.
    install_requires=[
        'filterpy>=2.0',  # 1.4.5 fails with numpy 2
        'matplotlib>=3.6',
        'mcap>=1.2',
        'numpy>=1.26',
        'ruamel.yaml>=0.17.21',
        'rosbags>=0.11',
        'scipy>=1.11',
        'threadpoolctl>=3.1',
        'tqdm>=4.66',
    ],
    extras_require={
        # What `identify`, `tune` and `compress --optimiser cma` search with, and nothing else.
        'identify': SEARCHES,
        'video': [VIDEO],
        'ros': ['ros-jazzy-rclpy[fastrtps]', 'ros-jazzy-common-interfaces'],
        'test': [
            *SEARCHES,
            'hypothesis>=6.100',
            'mcap-ros2-support>=0.5.5',
            VIDEO,
            'psutil>=5.9',
            'pytest>=7.4',
            'pytest-xdist>=3.8',
        ],
        # Bounded: newer linters find new faults in unchanged code.
        'lint': ['mypy>=2.4,<2.5', 'ruff>=0.17,<0.18'],
        # Not for the same environment as the rest: colcon-core needs setuptools<80.
        'colcon': [
            'colcon-core',
            'colcon-ros',
            'colcon-python-setup-py',
            'colcon-bash',
            'colcon-recursive-crawl',
        ],
    },
    entry_points={
        'console_scripts': [
            'cloth-predict = cloth_predict.cli:main',
            'mocap_replay_node = cloth_predict.nodes.start:mocap_replay_node',
            'ekf_node = cloth_predict.nodes.start:ekf_node',
            'projector_node = cloth_predict.nodes.start:projector_node',
            'rest_node = cloth_predict.nodes.start:rest_node',
            'video_node = cloth_predict.nodes.start:video_node',
            'ruler_node = cloth_predict.nodes.start:ruler_node',
        ],
    },
)
