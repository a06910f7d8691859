/* The controller of tank_c.py: levels in, voltages out, a line of each for every sample.
 *
 * tanks.h and tanks.c are exported with an observer and a disturbance on each input; law.h has the
 * rest and the gain. A level that is "nan" was not measured.
 */
#include <stdio.h>

#include "law.h"
#include "tanks.h"

#define STATES (TANKS_NX - TANKS_NU) /* the last ones are the disturbances */

int main(void)
{
    tanks_observer observer;
    double u[TANKS_NU], y[TANKS_NY];
    int i, j;

    tanks_observer_reset(&observer);
    for (i = 0; i < TANKS_NU; i++)
        u[i] = U_REST[i];
    for (j = 0; j < STATES; j++)
        observer.x[j] = X_REST[j];
    while (scanf("%lf %lf", &y[0], &y[1]) == 2) {
        tanks_observer_correct(&observer, u, y);
        for (i = 0; i < TANKS_NU; i++) {
            u[i] = U_REST[i] - observer.x[STATES + i];
            for (j = 0; j < STATES; j++)
                u[i] -= GAIN[i][j] * (observer.x[j] - X_REST[j]);
            u[i] = u[i] < LOW ? LOW : u[i] > HIGH ? HIGH : u[i];
        }
        tanks_observer_advance(&observer, u); /* with what the pumps can do: nothing winds up */
        printf("%.17g %.17g\n", u[0], u[1]);
        fflush(stdout);
    }
    return 0;
}
