"""sysidentpy as its book does for Silverbox and the drives: cubes of 14 lags, 40 terms."""

from given import every_u, keep, u, y
from sysidentpy.basis_function import Polynomial
from sysidentpy.model_structure_selection import FROLS
from sysidentpy.parameter_estimation import LeastSquares

model = FROLS(
    xlag=14,
    ylag=14,
    basis_function=Polynomial(degree=3),
    estimator=LeastSquares(),
    err_tol=0.9999,
    n_terms=40,
    order_selection=False,
)
model.fit(X=u, y=y)
keep(model.predict(X=every_u, y=y[: model.max_lag]))
