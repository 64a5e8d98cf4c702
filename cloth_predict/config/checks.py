"""What the values of a configuration have to fit each other in."""

from __future__ import annotations

from itertools import combinations

from cloth_predict.config.schema import Config, ModelConfig
from cloth_predict.errors import ConfigError

FEWEST_NODES = {'edges': 2, 'delaunay': 3, 'closed': 4}
"""By topology."""
OF_BODIES = ('decoupled', 'ekf', 'ukf', 'ckf')
"""Filters that follow a body."""
ONLY_OF_BODIES = ('decoupled',)
NEEDS_A_MARKER_PER_NODE = ('fixed_gain', 'recursive_least_squares')
"""Filters that lose a node which is never seen: its covariance grows for ever."""
NEEDS_A_FORCE_PER_NODE = ('fixed_gain', 'reduced_rank')
"""Filters whose covariances are those of a node with a force of its own."""


def _check_model(model: ModelConfig, source: str) -> None:
    """Check that the parameters of the topology fit each other."""
    if model.is_body != (model.topology == 'closed'):
        raise ConfigError(
            f'{source}.topology: {model.topology} has no meaning with kind {model.kind}'
        )
    for name, given, kinds in (
        ('nodes', model.nodes, tuple(FEWEST_NODES)),
        ('edges', model.edges, ('edges',)),
    ):
        if given and model.topology not in kinds:
            raise ConfigError(f'{source}.{name}: has no meaning with topology {model.topology}')
    if model.refine > 1 and model.topology != 'grid':
        raise ConfigError(f'{source}.refine: has no meaning with topology {model.topology}')
    if model.refine > 1 and model.rest_length != 'dimensions':
        raise ConfigError(
            f'{source}.refine: nobody sees the nodes between the markers, so that it needs '
            f'rest_length dimensions'
        )
    _check_lists(model, source)
    if model.topology == 'grid':
        return
    if model.nodes < FEWEST_NODES[model.topology]:
        raise ConfigError(
            f'{source}.nodes: topology {model.topology} needs a number of nodes of at least '
            f'{FEWEST_NODES[model.topology]}, here or by labels'
        )
    if model.rest_length == 'dimensions' and not model.is_body:
        raise ConfigError(
            f'{source}.rest_length: width and height tell nothing of topology {model.topology}; '
            f'choose measured or calibrated'
        )
    if model.topology == 'edges' and (flaw := _flaw_of_edges(model.nodes, model.edges)):
        raise ConfigError(f'{source}.edges: {flaw}')


def _check_lists(model: ModelConfig, source: str) -> None:
    """Check that what is given for each spring or node has a value for each of them."""
    for name, given, what in (
        ('springs', model.springs, 'springs'),
        ('dampers', model.dampers, 'springs'),
        ('masses', model.masses, 'nodes'),
        ('loads', model.loads, 'nodes'),
    ):
        if not given:
            continue
        if what == 'springs' and model.topology == 'delaunay':
            raise ConfigError(
                f'{source}.{name}: has no meaning with topology delaunay, whose springs are not '
                f'known before the start'
            )
        count = model.mesh_nodes if what == 'nodes' else number_of_springs(model)
        if len(given) != count:
            raise ConfigError(
                f'{source}.{name}: {len(given)} values, but the model has {count} {what}'
            )


def number_of_springs(model: ModelConfig) -> int:
    """Springs of a grid (Gomes 2016, eq. 5.5) or of listed edges, of all families."""
    if model.topology == 'grid':
        rows, cols = model.mesh
        structural = rows * (cols - 1) + cols * (rows - 1)
        flexion = rows * max(cols - 2, 0) + cols * max(rows - 2, 0)
        return structural + 2 * (rows - 1) * (cols - 1) + flexion
    pairs = {frozenset(pair) for pair in zip(model.edges[::2], model.edges[1::2], strict=False)}
    apart = {a ^ b for a, b in combinations(pairs, 2) if len(a & b) == 1}
    return len(pairs) + len(apart - pairs)


def _flaw_of_edges(nodes: int, flat: tuple[int, ...]) -> str:
    """Return what keeps a list of node pairs from being one mesh, or nothing."""
    if len(flat) % 2:
        return f'expected pairs of nodes, got {len(flat)} numbers'
    part, seen = list(range(nodes)), set()
    for i, j in zip(flat[::2], flat[1::2], strict=True):
        if max(i, j) >= nodes:
            return f'node {max(i, j)} does not exist, model.nodes has {nodes} nodes'
        if i == j:
            return f'node {i} is joined with itself'
        if (pair := frozenset((i, j))) in seen:
            return f'the pair {i}, {j} is listed twice'
        seen.add(pair)
        old, new = max(part[i], part[j]), min(part[i], part[j])
        part = [new if p == old else p for p in part]
    return f'no edges lead from node 0 to node {part.index(max(part))}' if any(part) else ''


def _check_vsync(config: Config, source: str) -> None:
    """Check that a frame can be made between one vsync and the next."""
    projector, period = config.projector, 1.0 / config.projector.fps
    if config.horizon_mode == 'vsync' and projector.lead >= period:
        raise ConfigError(
            f'{source}: projector.lead: {projector.lead:g} s is not less than the '
            f'{period:.4g} s of a frame at projector.fps'
        )


def _check_body(config: Config, source: str) -> None:
    """Check that a body is asked for nothing that only a surface of springs has."""
    model = config.model
    for name, given in (
        ('anchors.nodes', config.anchors.nodes),
        ('model.springs', model.springs),
        ('model.dampers', model.dampers),
        ('model.masses', model.masses),
        ('model.loads', model.loads),
        ('force.kind', config.force.kind != 'none'),
        ('wind.kind', config.wind.kind != 'none'),
    ):
        if given:
            raise ConfigError(f'{source}: {name}: has no meaning with model.kind {model.kind}')
    if 0 < config.body.nodes < FEWEST_NODES['closed']:
        raise ConfigError(
            f'{source}: body.nodes: a closed mesh has at least {FEWEST_NODES["closed"]} nodes'
        )
    if len(config.labels) > model.nodes:
        raise ConfigError(
            f'{source}: labels: {len(config.labels)} labels, but model.nodes has only '
            f'{model.nodes} nodes'
        )


def check_together(config: Config, source: str) -> None:
    """Raise ConfigError, which names `source`, where values do not fit each other."""
    _check_model(config.model, f'{source}: model')
    if lack := misfit(config, config.filter.kind):
        raise ConfigError(f'{source}: {lack}')
    if len(set(config.labels)) != len(config.labels):
        raise ConfigError(f'{source}: labels: a label is listed twice')
    if len(set(config.horizons)) != len(config.horizons):
        raise ConfigError(f'{source}: horizons: a horizon is listed twice')
    _check_vsync(config, source)
    nodes = config.model.count
    chain = config.model.topology == 'grid' and 1 in config.model.mesh
    if config.wind.kind != 'none' and (chain or config.model.topology == 'edges'):
        raise ConfigError(f'{source}: wind.kind: a chain or a list of edges has no normals')
    if config.model.is_body:
        _check_body(config, source)
    elif config.labels and len(config.labels) != nodes:
        raise ConfigError(
            f'{source}: labels: {len(config.labels)} labels, but {config.model.counted_by} has '
            f'{nodes} nodes'
        )
    outside = [node for node in config.anchors.nodes if node >= nodes]
    if outside:
        raise ConfigError(
            f'{source}: anchors.nodes: node {outside[0]} does not exist, '
            f'{config.model.counted_by} has {nodes} nodes'
        )
    if len(set(config.anchors.nodes)) != len(config.anchors.nodes):
        raise ConfigError(f'{source}: anchors.nodes: a node is listed twice')
    if len(config.anchors.nodes) == nodes:
        raise ConfigError(
            f'{source}: anchors.nodes: every node is driven, nothing is left to predict'
        )


def misfit(config: Config, kind: str) -> str:
    """Return why a kind of filter does not work with the rest of a configuration, or nothing."""
    body = config.model.is_body
    if kind not in OF_BODIES if body else kind in ONLY_OF_BODIES:
        return f'filter.kind {kind} does not work with model.kind {config.model.kind}'
    if config.model.refine > 1 and kind in NEEDS_A_MARKER_PER_NODE:
        return f'filter.kind {kind} needs model.refine 1'
    if config.wind.kind != 'none' and kind in NEEDS_A_FORCE_PER_NODE:
        return f'filter.kind {kind} needs wind.kind none'
    return ''
