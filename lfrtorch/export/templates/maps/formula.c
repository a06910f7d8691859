{% macro assigned(to, formula) %}
{% set operations, results = statements(formula, "z[{}]") %}
    (void)z;
{% for name, value in operations %}
    const double {{ name }} = {{ value }};
{% endfor %}
{% for value in results %}
    {{ to }}[{{ loop.index0 }}] = {{ value }};
{% endfor %}
{% endmacro %}
/* w = f(z). */
static void map(const double *z, double *w)
{
{{ assigned("w", written.formula) -}}
}

/* J = dw/dz. */
static void map_jacobian(const double *z, double *J)
{
{{ assigned("J", slopes(written.formula)) -}}
}
