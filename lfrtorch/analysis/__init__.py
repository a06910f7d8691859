"""What a fitted model is, and how far it may be trusted: residuals, poles, amplitudes."""

from lfrtorch.analysis.residual_analysis import Residuals, residuals

__all__ = ["Residuals", "residuals"]
