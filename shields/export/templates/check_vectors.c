/* Replays vectors.txt through the filter and compares every decision, flag, input and estimate. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include "ncs_filter.h"

static char word[64];

static const char *next(FILE *file) { return fscanf(file, "%63s", word) == 1 ? word : ""; }
static double number(FILE *file) { return strtod(next(file), NULL); }

static void numbers(FILE *file, double *to, int count)
{
    while (count-- > 0)
        *to++ = number(file);
}

static int differ(double value, double wanted, double scale)
{
    double away = value < wanted ? wanted - value : value - wanted;
    return !(away <= 1e-9 * scale);
}

int main(void)
{
    static ncs_filter f;
    double x[NCS_N], y[NCS_P], proposed[NCS_M], u[NCS_M], wanted[NCS_M], scale;
    long steps = 0, wrong = 0;
    uint32_t episode, stamp;
    int k, decision, reason, bad;
    FILE *file = fopen("vectors.txt", "r");
    if (file == NULL)
        return 2;
    while (*next(file)) {
        if (!strcmp(word, "start")) {
            episode = (uint32_t)strtoul(next(file), NULL, 10);
            numbers(file, x, NCS_N);
            wrong += !ncs_start(&f, episode, x);
        } else if (!strcmp(word, "sample")) {
            episode = (uint32_t)strtoul(next(file), NULL, 10);
            stamp = (uint32_t)strtoul(next(file), NULL, 10);
            numbers(file, y, NCS_P);
            ncs_receive(&f, episode, stamp, y);
        } else if (!strcmp(word, "applied")) {
            numbers(file, u, NCS_M);
            ncs_applied(&f, u);
        } else {
            numbers(file, proposed, NCS_M);
            numbers(file, x, NCS_N);
            for (bad = 0, k = 0; k < NCS_N; k++) {
                scale = 1.0 + (x[k] < 0.0 ? -x[k] : x[k]);
                bad |= differ(f.estimate[k], x[k], scale);
            }
            decision = atoi(next(file));
            reason = atoi(next(file));
            numbers(file, wanted, NCS_M);
            bad |= ncs_decide(&f, proposed, u) != decision || f.reason != reason;
            for (k = 0; k < NCS_M; k++)
                bad |= differ(u[k], wanted[k], 1.0 + (wanted[k] < 0.0 ? -wanted[k] : wanted[k]));
            wrong += bad;
            steps++;
        }
    }
    fclose(file);
    printf("%ld steps, %ld wrong; the filter takes %lu bytes\n", steps, wrong, (unsigned long)sizeof f);
    return wrong > 0 || steps == 0;
}
