{% set K, G = "K" in roots, "G" in roots %}
/*
{% for line in about %}
{{ (" * " ~ line).rstrip() }}
{% endfor %}
 */
#ifndef {{ NAME }}_H
#define {{ NAME }}_H

#define {{ NAME }}_NX {{ nx }} /* states */
#define {{ NAME }}_NU {{ nu }} /* inputs */
#define {{ NAME }}_NY {{ ny }} /* outputs */
#define {{ NAME }}_TS {{ ts }} /* sampling time, s */

#ifdef __cplusplus
extern "C" {
#endif

/* The state to start from: x = 0, where lfrtorch simulate begins. */
void {{ name }}_reset(double x[{{ NAME }}_NX]);

{% if rest %}
/* The state that stays with the inputs at their operating point; no simulation begins here. */
void {{ name }}_rest(double x[{{ NAME }}_NX]);

{% endif %}
/* The output y at this sample, and the state at the next one. x_next may be x itself. */
void {{ name }}_step(const double x[{{ NAME }}_NX], const double u[{{ NAME }}_NU],
    double x_next[{{ NAME }}_NX], double y[{{ NAME }}_NY]);

/* The model linearised at x and u: its matrices A = dx_next/dx, B = dx_next/du, C = dy/dx and
 * D = dy/du, row by row. */
void {{ name }}_jacobians(const double x[{{ NAME }}_NX], const double u[{{ NAME }}_NU],
    double dx_dx[{{ NAME }}_NX * {{ NAME }}_NX], double dx_du[{{ NAME }}_NX * {{ NAME }}_NU],
    double dy_dx[{{ NAME }}_NY * {{ NAME }}_NX], double dy_du[{{ NAME }}_NY * {{ NAME }}_NU]);

{% if distance %}
/* How far x and u are from the middle of the data of the fit, squared: 99 % of them are within 1.
 * Beyond it the model extrapolates. */
double {{ name }}_reach(const double x[{{ NAME }}_NX], const double u[{{ NAME }}_NU]);

{% endif %}
{% if K or G %}
/* An observer: the states of the running system, from its inputs and its outputs. Once a sample
 * call either predict and update, or correct and advance: correct before the input is chosen. */
typedef struct {
    double x[{{ NAME }}_NX]; /* the state, of the next sample to be predicted or after correct */
{% if G %}
    double U[{{ NAME }}_NX * {{ NAME }}_NX]; /* U times its transpose: covariance of predicted x */
{% endif %}
    double u[{{ NAME }}_NU], y_hat[{{ NAME }}_NY]; /* of the last call of predict or correct */
{% if K %}
    double e[{{ NAME }}_NY]; /* y - y_hat, from correct to advance */
{% else %}
    double M[({{ NAME }}_NY + 2 * {{ NAME }}_NX) * ({{ NAME }}_NY + 2 * {{ NAME }}_NX)];
    double noise[{{ NAME }}_NX]; /* these are from correct to advance */
    int corrected, known;
{% endif %}
} {{ name }}_observer;

/* The state to start from: x = 0{% if G %}, with the covariance that the states have in the
 * data of the fit{% endif %}. */
void {{ name }}_observer_reset({{ name }}_observer *observer);

/* The output at this sample, y_hat, from the input now and all samples before. */
void {{ name }}_observer_predict({{ name }}_observer *observer, const double u[{{ NAME }}_NU],
    double y_hat[{{ NAME }}_NY]);

/* Go on to the next sample with the measured output; NaN is one that is missing. */
void {{ name }}_observer_update({{ name }}_observer *observer, const double y[{{ NAME }}_NY]);

{% if K %}
/* Keep the output of this sample for advance: with a constant gain it corrects the next state.
{% else %}
/* Correct x by the output of this sample; NaN is one that is missing.
{% endif %}
{% if feedthrough %}
 * The output depends on the input u at the same sample. */
{% else %}
 * No output depends on the input at the same sample: any u will do. */
{% endif %}
void {{ name }}_observer_correct({{ name }}_observer *observer, const double u[{{ NAME }}_NU],
    const double y[{{ NAME }}_NY]);

/* Go on to the next sample with the input of this one; one not corrected has no output. */
void {{ name }}_observer_advance({{ name }}_observer *observer, const double u[{{ NAME }}_NU]);

{% endif %}
#ifdef __cplusplus
}
#endif

#endif
