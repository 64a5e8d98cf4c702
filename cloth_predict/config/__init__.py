"""The configuration: one tree of frozen dataclasses, the only source of defaults.

YAML files, ROS parameters and docs/parameters.md derive from it.
"""

from cloth_predict.config.body import BodyConfig
from cloth_predict.config.build import (
    build,
    build_group,
    dump,
    flatten,
    load,
    nest,
    parameters_in,
    parse_yaml,
)
from cloth_predict.config.checks import misfit
from cloth_predict.config.projector import ProjectorConfig
from cloth_predict.config.rest import RestConfig
from cloth_predict.config.schema import (
    AnchorsConfig,
    AssociationConfig,
    BaselineConfig,
    Config,
    FilterConfig,
    ForceConfig,
    LimitsConfig,
    LiveCheckConfig,
    ModelConfig,
    ReplayConfig,
    WindConfig,
)

__all__ = [
    'AnchorsConfig',
    'AssociationConfig',
    'BaselineConfig',
    'BodyConfig',
    'Config',
    'FilterConfig',
    'ForceConfig',
    'LimitsConfig',
    'LiveCheckConfig',
    'ModelConfig',
    'ProjectorConfig',
    'ReplayConfig',
    'RestConfig',
    'WindConfig',
    'build',
    'build_group',
    'dump',
    'flatten',
    'load',
    'misfit',
    'nest',
    'parameters_in',
    'parse_yaml',
]
