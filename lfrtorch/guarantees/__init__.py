"""Proofs about a model: that it contracts, and bounds of its signals.

No other package imports this one at its start: a fit loads it for ``guarantee="contracting"``, and
``analysis`` loads it at its first use. Certificates need clarabel: pip install
'lfrtorch[certificate]'.
"""

from lfrtorch.guarantees.bounds import Bound, bound
from lfrtorch.guarantees.contraction import Contraction, contraction

__all__ = ["Bound", "Contraction", "bound", "contraction"]
