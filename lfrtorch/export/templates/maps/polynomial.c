enum { NM = {{ weights.C.shape[1] }} }; /* monomials */

{{ constant("C", "NW * NM", weights.C) }}
/* Monomial i + 1 is one monomial times one z. */
static const int growth[NM - 1][2] = {{ pairs(weights.growth) }};

/* m = 1, z1, z2, .., z1 z1, z1 z2, ..: each is an earlier one times one z. */
static void products(const double *z, double *m)
{
    m[0] = 1.0;
    for (int i = 1; i < NM; i++)
        m[i] = m[growth[i - 1][0]] * z[growth[i - 1][1]];
}

/* w = f(z). */
static void map(const double *z, double *w)
{
    double m[NM];
    products(z, m);
    for (int i = 0; i < NW; i++)
        w[i] = 0.0;
    add(w, C, m, NW, NM);
}

/* J = dw/dz, by the product rule. */
static void map_jacobian(const double *z, double *J)
{
    double m[NM], dm[NM * NZ] = {0.0};
    products(z, m);
    for (int i = 1; i < NM; i++) {
        const int before = growth[i - 1][0], k = growth[i - 1][1];
        for (int j = 0; j < NZ; j++)
            dm[i * NZ + j] = dm[before * NZ + j] * z[k];
        dm[i * NZ + k] += m[before];
    }
    for (int i = 0; i < NW * NZ; i++)
        J[i] = 0.0;
    add_product(J, C, dm, NW, NM, NZ);
}
