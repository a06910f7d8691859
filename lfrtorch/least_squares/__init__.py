"""Minimising |r(θ)|²: problems, their Jacobians, linear systems and searches."""
