{% set assignments = operations(written.formula) %}
/* w = f(z). */
static void map(const double *z, double *w)
{
    (void)z;
{% for to, value in assignments.map %}
    {{ to }} = {{ value }};
{% endfor %}
}

/* J = dw/dz. */
static void map_jacobian(const double *z, double *J)
{
    (void)z;
{% for to, value in assignments.jacobian %}
    {{ to }} = {{ value }};
{% endfor %}
}
