"""The best linear approximation: nonparametric and parametric, from signals or spectra.

Read the files in the order of the work:

1. ``spectra``, ``realisations``: spectra of records by period, and the lines that inputs excite
2. ``regression``, ``local_polynomial``, ``frf``: frequency response with its variances
3. ``requirements``, ``spectral_data``: requirements on data, and the spectra that are fitted
4. ``subspace``: first estimates of A and C
5. ``signal_fit``, ``response_fit``: least-squares problems on signals and on spectra; the problems
   on spectra use ``resolvent`` or ``modal_jacobian``, and ``pole_limits``
6. ``refinement``, ``minima``: Levenberg-Marquardt from several starts, to the best minimum
7. ``bla``: all these steps together, and ``integrators`` behind the outputs
8. ``order_fits``, ``order_scan``: models of several orders, and the order that is chosen
9. ``model``, ``modes``: the result, and its modes that matter
10. ``record_start``: whether a record begins at rest, by the errors of two linear models
"""
