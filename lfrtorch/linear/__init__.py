"""The best linear approximation: nonparametric and parametric, from signals or spectra."""
