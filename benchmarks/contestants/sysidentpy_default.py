"""sysidentpy as its quick start: FROLS with its defaults, squares of two lags."""

from given import every_u, keep, u, y
from sysidentpy.basis_function import Polynomial
from sysidentpy.model_structure_selection import FROLS

model = FROLS(ylag=2, xlag=2, basis_function=Polynomial(degree=2))
model.fit(X=u, y=y)
keep(model.predict(X=every_u, y=y[: model.max_lag]))
