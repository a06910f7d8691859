enum { NN = {{ weights.bz | length }} };

{{ constant("Wz", "NN * NZ", weights.Wz) }}
{{ constant("bz", "NN", weights.bz) }}
{{ constant("Ww", "NW * NN", weights.Ww) }}
{{ constant("bw", "NW", weights.bw) }}

/* v = Wz z + bz and h = {{ map.activation }}(v). */
static void neurons(const double *z, double *v, double *h)
{
    copy(v, bz, NN);
    add(v, Wz, z, NN, NZ);
    for (int i = 0; i < NN; i++)
        h[i] = {{ map.sigma.c[0] }};
}

/* w = f(z). */
static void map(const double *z, double *w)
{
    double v[NN], h[NN];
    neurons(z, v, h);
    copy(w, bw, NW);
    add(w, Ww, h, NW, NN);
}

/* J = dw/dz. */
static void map_jacobian(const double *z, double *J)
{
    double v[NN], h[NN], dh[NN * NZ];
    neurons(z, v, h);
    for (int i = 0; i < NN; i++)
        for (int j = 0; j < NZ; j++)
            dh[i * NZ + j] = Wz[i * NZ + j] * ({{ map.sigma.c[1] }});
    for (int i = 0; i < NW * NZ; i++)
        J[i] = 0.0;
    add_product(J, Ww, dh, NW, NN, NZ);
}
