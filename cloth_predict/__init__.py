"""Live prediction of deforming surfaces for projection: where a moving surface will be."""

__version__ = '0.1.0'
