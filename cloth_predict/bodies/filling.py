"""Nodes that no marker sits on: they are where the membrane holds them between those with one.

The energy of the membrane says how likely displacements are, p(d) ~ exp(-d'K d / 2 tau): they are
a Gaussian Markov random field (Rue and Held 2005, section 2.2). Given those of the nodes with
markers, s, the others, u, have the mean -K_uu^-1 K_us d_s, which is the membrane at rest, and the
covariance tau K_uu^-1; with tau the displacements with markers are as likely as can be.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from cloth_predict.filters.blocks import BlockGaussian
from cloth_predict.models.superquadric import LOCAL, Superquadric
from cloth_predict.types import Belief, FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Filling:
    """How the displacements of some nodes follow from those of others.

    seen, shape (s,), and unseen, shape (u,): nodes; weight, shape (u, s); variance, shape (u,): of
    what is left of each unseen node, for tau 1; stiffness, shape (s, s): K with the unseen nodes
    at rest.
    """

    dim_q: int
    seen: IntArray
    unseen: IntArray
    weight: FloatArray
    variance: FloatArray
    stiffness: FloatArray

    @classmethod
    def of(cls, body: Superquadric, nodes: IntArray) -> Filling:
        """Fill in between these nodes, some of which may be there twice."""
        seen = np.unique(nodes)
        unseen = np.setdiff1d(np.arange(body.nodes), seen)
        springs = body.membrane.matrix().toarray()
        across = springs[np.ix_(unseen, seen)]
        inverse = np.zeros((len(unseen), len(unseen)))
        if len(unseen):  # LAPACK takes no empty matrix in older scipy
            inverse = cho_solve(cho_factor(springs[np.ix_(unseen, unseen)]), np.eye(len(unseen)))
        weight = -inverse @ across
        held = springs[np.ix_(seen, seen)] + across.T @ weight
        return cls(body.dim_q, seen, unseen, weight, np.diag(inverse), held)

    def between(self, nodes: IntArray, body: Superquadric) -> Filling:
        """The filling between these nodes: the same as long as they are."""
        same = np.array_equal(np.unique(nodes), self.seen)
        return self if same else Filling.of(body, nodes)

    def applied(self, belief: Belief) -> Belief:
        """The belief with the displacements of the unseen nodes, and their rates, filled in."""
        if not len(self.unseen) or not isinstance(belief, BlockGaussian) or not len(belief.own):
            return belief
        mean, own = belief.mean.copy(), belief.own.copy()
        own[self.unseen] = np.einsum('us,sij->uij', self.weight**2, own[self.seen])
        for k, begin in enumerate((LOCAL, self.dim_q + LOCAL)):
            values = mean[begin : begin + self.dim_q - LOCAL].reshape(-1, 3)
            given = values[self.seen]
            values[self.unseen] = self.weight @ given
            tau = float(np.sum(given * (self.stiffness @ given))) / given.size
            part = np.arange(3 * k, 3 * k + 3)
            own[self.unseen[:, None], part, part] += tau * self.variance[:, None]
        return replace(belief, mean=mean, own=own)
