"""Which marker is which node."""

from __future__ import annotations

from cloth_predict.config import Config
from cloth_predict.errors import FormatError
from cloth_predict.types import MarkerSequence


def markers_of_nodes(sequence: MarkerSequence, config: Config, source: str) -> MarkerSequence:
    """Put a recording's markers in node order, as chosen by the parameter `labels`.

    Without `labels` the order of the recording is that of the nodes. Raises FormatError naming the
    recording and the label or the two sizes that do not fit.
    """
    if config.labels:
        sequence = choose(sequence, config.labels, source)
    nodes = config.model.rows * config.model.cols
    if len(sequence.labels) != nodes:
        raise FormatError(
            f'{source}: {len(sequence.labels)} markers ({_listed(sequence.labels)}) do not fit '
            f'model.rows x model.cols = {config.model.rows} x {config.model.cols} = {nodes} '
            f'nodes; choose the markers with the parameter labels'
        )
    return sequence


def choose(sequence: MarkerSequence, labels: tuple[str, ...], source: str) -> MarkerSequence:
    """Return these markers, in this order. Raises FormatError naming a label that is not there."""
    column = {label: i for i, label in enumerate(sequence.labels)}
    for label in labels:
        if label not in column:
            raise FormatError(
                f'{source}: no marker {label!r} (there are {_listed(sequence.labels)})'
            )
    return sequence.select([column[label] for label in labels])


def _listed(labels: tuple[str, ...], most: int = 4) -> str:
    shown = ', '.join(labels[:most])
    return f'{shown}, ... {labels[-1]}' if len(labels) > most else shown or 'none'
