/* Replays vectors.txt through the filter and compares every estimate, decision, flag and input. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include "ncs_filter.h"

static FILE *file;
static char word[64];

static const char *next(void) { return fscanf(file, "%63s", word) == 1 ? word : ""; }
static uint32_t whole(void) { return (uint32_t)strtoul(next(), NULL, 10); }

static const double *numbers(double *to, int count)
{
    int k;
    for (k = 0; k < count; k++)
        to[k] = strtod(next(), NULL);
    return to;
}

/* Whether numbers differ from the next ones of the file by more than rounding. */
static int differ(const double *found, int count)
{
    double wanted, away;
    int k, result = 0;
    for (k = 0; k < count; k++) {
        wanted = strtod(next(), NULL);
        away = found[k] - wanted;
        result |= !(away * away <= 1e-18 * (1.0 + wanted * wanted));
    }
    return result;
}

int main(void)
{
    static ncs_filter f;
    double given[NCS_N + NCS_M + NCS_P], u[NCS_M];
    long steps = 0, wrong = 0;
    uint32_t episode, stamp;
    int bad;
    if ((file = fopen("vectors.txt", "r")) == NULL)
        return 2;
    while (*next()) {
        if (!strcmp(word, "start")) {
            episode = whole();
            wrong += !ncs_start(&f, episode, numbers(given, NCS_N));
        } else if (!strcmp(word, "sample")) {
            episode = whole();
            stamp = whole();
            ncs_receive(&f, episode, stamp, numbers(given, NCS_P));
        } else if (!strcmp(word, "applied")) {
            ncs_applied(&f, numbers(given, NCS_M));
        } else {
            numbers(given, NCS_M);
            bad = differ(f.estimate, NCS_N);
            bad |= ncs_decide(&f, given, u) != (int)whole();
            bad |= f.reason != (int)whole();
            wrong += bad | differ(u, NCS_M);
            steps++;
        }
    }
    printf("%ld steps, %ld wrong; the filter takes %lu bytes\n", steps, wrong, (unsigned long)sizeof f);
    return wrong > 0 || steps == 0;
}
