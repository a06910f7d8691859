{% set K, G = "K" in roots, "G" in roots %}
/* See {{ name }}.h. */
#include "{{ name }}.h"

#include <math.h>

enum {
    NX = {{ NAME }}_NX,
    NU = {{ NAME }}_NU,
    NY = {{ NAME }}_NY,
{% if nw %}
    NZ = {{ nz }},
    NW = {{ nw }},
{% endif %}
{% if G %}
    NG = NY + NX, /* noise of outputs and states */
    NC = NG + NX, /* columns of M, and its most rows */
{% endif %}
};

{% set sizes = {
    "u_offset": "NU", "y_offset": "NY", "x_rest": "NX", "A": "NX * NX", "Bu": "NX * NU",
    "Bw": "NX * NW", "Cz": "NZ * NX", "Dzu": "NZ * NU", "Cy": "NY * NX", "Dyu": "NY * NU",
    "Dyw": "NY * NW",
} %}
{% for array, size in sizes.items() if arrays[array].size %}
{{ constant(array, size, arrays[array]) }}
{% endfor %}
{% if distance %}
{{ constant("reach_T", "NZ * NZ", distance[0]) }}
{{ constant("reach_t", "NZ", distance[1]) }}
{% endif %}
{% if K %}
{{ constant("K", "NX * NY", roots.K) }}
{% endif %}
{% if G %}
/* G times G transposed: covariance of y's and x's noise. */
{{ constant("G", "NG * NG", roots.G) }}
/* U0 times U0 transposed: covariance of x in the data. */
{{ constant("U0", "NX * NX", roots.U0) }}
{% endif %}

/* to += M v, with M of rows x columns. */
static void add(double *to, const double *M, const double *v, int rows, int columns)
{
    for (int i = 0; i < rows; i++)
        for (int j = 0; j < columns; j++)
            to[i] += M[i * columns + j] * v[j];
}

{% if nw or G %}
/* to += M N, with M of rows x inner and N of inner x columns. */
static void add_product(double *to, const double *M, const double *N, int rows, int inner,
    int columns)
{
    for (int i = 0; i < rows; i++)
        for (int k = 0; k < inner; k++)
            for (int j = 0; j < columns; j++)
                to[i * columns + j] += M[i * inner + k] * N[k * columns + j];
}

{% endif %}
static void copy(double *to, const double *from, int count)
{
    for (int i = 0; i < count; i++)
        to[i] = from[i];
}

/* v = u - u_offset. */
static void deviation(const double *u, double *v)
{
    for (int i = 0; i < NU; i++)
        v[i] = u[i] - u_offset[i];
}

{% if nw %}
{% include "maps/" ~ written.template ~ ".c" %}

{% endif %}
void {{ name }}_reset(double x[NX])
{
    for (int i = 0; i < NX; i++)
        x[i] = 0.0;
}

{% if rest %}
void {{ name }}_rest(double x[NX])
{
    copy(x, x_rest, NX);
}

{% endif %}
void {{ name }}_step(const double x[NX], const double u[NU], double x_next[NX], double y[NY])
{
    double v[NU], next[NX] = {0.0};
    deviation(u, v);
    copy(y, y_offset, NY);
    add(y, Cy, x, NY, NX);
    add(y, Dyu, v, NY, NU);
    add(next, A, x, NX, NX);
    add(next, Bu, v, NX, NU);
{% if nw %}
    double z[NZ] = {0.0}, w[NW];
    add(z, Cz, x, NZ, NX);
    add(z, Dzu, v, NZ, NU);
    map(z, w);
    add(y, Dyw, w, NY, NW);
    add(next, Bw, w, NX, NW);
{% endif %}
    copy(x_next, next, NX);
}

void {{ name }}_jacobians(const double x[NX], const double u[NU], double dx_dx[NX * NX],
    double dx_du[NX * NU], double dy_dx[NY * NX], double dy_du[NY * NU])
{
    copy(dx_dx, A, NX * NX);
    copy(dx_du, Bu, NX * NU);
    copy(dy_dx, Cy, NY * NX);
    copy(dy_du, Dyu, NY * NU);
{% if nw %}
    double v[NU], z[NZ] = {0.0}, J[NW * NZ], dw_dx[NW * NX] = {0.0}, dw_du[NW * NU] = {0.0};
    deviation(u, v);
    add(z, Cz, x, NZ, NX);
    add(z, Dzu, v, NZ, NU);
    map_jacobian(z, J);
    add_product(dw_dx, J, Cz, NW, NZ, NX);
    add_product(dw_du, J, Dzu, NW, NZ, NU);
    add_product(dx_dx, Bw, dw_dx, NX, NW, NX);
    add_product(dx_du, Bw, dw_du, NX, NW, NU);
    add_product(dy_dx, Dyw, dw_dx, NY, NW, NX);
    add_product(dy_du, Dyw, dw_du, NY, NW, NU);
{% else %}
    (void)x, (void)u; /* the model is linear: the same everywhere */
{% endif %}
}
{% if distance %}

double {{ name }}_reach(const double x[NX], const double u[NU])
{
    double v[NU], z[NZ] = {0.0}, distance[NZ], square = 0.0;
    deviation(u, v);
    add(z, Cz, x, NZ, NX);
    add(z, Dzu, v, NZ, NU);
    for (int i = 0; i < NZ; i++)
        distance[i] = -reach_t[i];
    add(distance, reach_T, z, NZ, NZ);
    for (int i = 0; i < NZ; i++)
        square += distance[i] * distance[i];
    return square;
}
{% endif %}
{% if K or G %}

void {{ name }}_observer_reset({{ name }}_observer *observer)
{
    static const {{ name }}_observer zero;
    *observer = zero;
{% if G %}
    copy(observer->U, U0, NX * NX);
{% endif %}
}

void {{ name }}_observer_predict({{ name }}_observer *observer, const double u[NU], double y_hat[NY])
{
    double next[NX];
    copy(observer->u, u, NU);
    {{ name }}_step(observer->x, u, next, observer->y_hat);
    copy(y_hat, observer->y_hat, NY);
}

{% endif %}
{% if K %}
void {{ name }}_observer_correct({{ name }}_observer *observer, const double u[NU], const double y[NY])
{
    double y_hat[NY];
    {{ name }}_observer_predict(observer, u, y_hat);
    for (int i = 0; i < NY; i++)
        observer->e[i] = isnan(y[i]) ? 0.0 : y[i] - y_hat[i];
}

/* x_next = f(x, u) + K (y - y_hat). */
void {{ name }}_observer_advance({{ name }}_observer *observer, const double u[NU])
{
    double y_hat[NY];
    {{ name }}_step(observer->x, u, observer->x, y_hat);
    add(observer->x, K, observer->e, NX, NY);
    for (int i = 0; i < NY; i++)
        observer->e[i] = 0.0;
}
{% endif %}
{% if G %}
/* M times an orthogonal matrix that makes its first rows lower triangular. Each of its rows has
 * some columns, and begins NC numbers after the last. */
static void reflect(double *M, int rows, int count, int columns)
{
    for (int k = 0; k < rows; k++) {
        double *row = M + k * NC, square = 0.0;
        for (int j = k; j < columns; j++)
            square += row[j] * row[j];
        if (square == 0.0)
            continue;
        double diagonal = row[k] > 0.0 ? -sqrt(square) : sqrt(square);
        double v = row[k] - diagonal, scale = 1.0 / (square - diagonal * row[k]);
        for (int i = k + 1; i < count; i++) {
            double *other = M + i * NC, a = other[k] * v;
            for (int j = k + 1; j < columns; j++)
                a += other[j] * row[j];
            a *= scale;
            other[k] -= a * v;
            for (int j = k + 1; j < columns; j++)
                other[j] -= a * row[j];
        }
        row[k] = diagonal;
        for (int j = k + 1; j < columns; j++)
            row[j] = 0.0;
    }
}

/* The extended Kalman filter on square roots. The rows of M are roots, of the innovations that are
 * known, of the states and of their noise; the columns are the noise and the states before. */
void {{ name }}_observer_correct({{ name }}_observer *observer, const double u[NU], const double y[NY])
{
    double *x = observer->x, *U = observer->U, *M = observer->M;
    double F[NX * NX], B[NX * NU], H[NY * NX], D[NY * NU], HU[NY * NX] = {0.0};
    double e[NY], y_hat[NY];
    int known = 0;

    /* With H = dy/dx at the state before. */
    {{ name }}_observer_predict(observer, u, y_hat);
    {{ name }}_jacobians(x, u, F, B, H, D);
    add_product(HU, H, U, NY, NX, NX);
    for (int i = 0; i < NC * NC; i++)
        M[i] = 0.0;
    for (int i = 0; i < NY; i++) {
        if (isnan(y[i]))
            continue;
        e[known] = y[i] - y_hat[i];
        copy(M + known * NC, G + i * NG, NG);
        copy(M + known * NC + NG, HU + i * NX, NX);
        known++;
    }
    double *states = M + known * NC, *moved = states + NX * NC;
    for (int i = 0; i < NX; i++) {
        copy(states + i * NC + NG, U + i * NX, NX);
        copy(moved + i * NC, G + (NY + i) * NG, NG);
        observer->noise[i] = 0.0;
    }
    reflect(M, known, known + 2 * NX, NC);
    for (int a = 0; a < known; a++) {
        for (int b = 0; b < a; b++)
            e[a] -= M[a * NC + b] * e[b];
        e[a] /= M[a * NC + a];
        for (int i = 0; i < NX; i++) {
            x[i] += states[i * NC + a] * e[a];
            observer->noise[i] += moved[i * NC + a] * e[a];
        }
    }
    observer->known = known;
    observer->corrected = 1;
}

void {{ name }}_observer_advance({{ name }}_observer *observer, const double u[NU])
{
    double *x = observer->x, *M = observer->M, N[NX * NC] = {0.0};
    double F[NX * NX], B[NX * NU], H[NY * NX], D[NY * NU], y_hat[NY];

    if (!observer->corrected) {
        for (int i = 0; i < NY; i++)
            y_hat[i] = NAN;
        {{ name }}_observer_correct(observer, u, y_hat);
    }
    /* With F = dx_next/dx at the state that knows the output. */
    const int known = observer->known;
    const double *states = M + known * NC, *moved = states + NX * NC;
    {{ name }}_jacobians(x, u, F, B, H, D);
    {{ name }}_step(x, u, x, y_hat);
    for (int i = 0; i < NX; i++) {
        x[i] += observer->noise[i];
        for (int j = 0; j < NC - known; j++) {
            N[i * NC + j] = moved[i * NC + known + j];
            for (int n = 0; n < NX; n++)
                N[i * NC + j] += F[i * NX + n] * states[n * NC + known + j];
        }
    }
    reflect(N, NX, NX, NC - known);
    for (int i = 0; i < NX; i++)
        copy(observer->U + i * NX, N + i * NC, NX);
    observer->corrected = 0;
}
{% endif %}
{% if K or G %}

void {{ name }}_observer_update({{ name }}_observer *observer, const double y[NY])
{
    {{ name }}_observer_correct(observer, observer->u, y);
    {{ name }}_observer_advance(observer, observer->u);
}
{% endif %}
