"""The best linear approximation: nonparametric and parametric, from signals or spectra.

The files in the order of the work, which is a good one to read them in:

1. ``spectra``, ``realisations``: spectra of records by period, and the lines that inputs excite
2. ``regression``, ``local_polynomial``, ``frf``: frequency response with its variances
3. ``requirements``, ``spectral_data``: what data must have, and the spectra that are fitted
4. ``subspace``: first estimates of A and C
5. ``signal_fit``, ``response_fit``: least-squares problems on signals and on spectra; the latter by
   ``resolvent`` or ``modal_jacobian``, within ``pole_limits``
6. ``refinement``, ``minima``: Levenberg-Marquardt from several starts, to the best minimum
7. ``bla``: these steps in one, and ``integrators`` behind the outputs
8. ``order_fits``, ``order_scan``: models of several orders, and the order that is chosen
9. ``model``, ``modes``: the result, and the modes of it that matter
10. ``record_start``: whether a record begins at rest, by what its linear models say
"""
