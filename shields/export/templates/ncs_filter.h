/* A safety filter with its estimator, written by `ncs verify --c` (documentation: "Deployment and C"). No heap, no libm.

   Once per control step: ncs_receive for each sample that has arrived, the oldest first, then ncs_decide, whose input
   acts at once, until the next step. Samples carry the number of the step at which they were taken, and that of the
   episode. A sample taken just before ncs_decide has the stamp f->step. */
#ifndef NCS_FILTER_H
#define NCS_FILTER_H
#include <stdint.h>

@SIZES@
typedef @REAL@ ncs_real; /* of the rows of the safe set; all else is double */
/* What became of a proposal. */
enum { NCS_SAFE, NCS_PROJECTED, NCS_FALLBACK, NCS_INVALID, NCS_NOT_STARTED };
/* Why the state is not proved to be in the safe set at the step of the last decision; all but the last three stay. */
enum {
    NCS_GUARANTEED, NCS_ALARM, NCS_OTHER_INPUT, NCS_NOT_FINITE, NCS_FAR_OUT, NCS_LOST_CONTRACT, NCS_STOPPED,
    NCS_NOT_KNOWN_INSIDE, NCS_OLD_SAMPLE
};

typedef struct {
    double estimate[NCS_N];             /* at this step */
    double base[NCS_N];                 /* `count` steps ago */
    double inputs[NCS_H + 1][NCS_M];    /* since then, the oldest first */
    uint32_t count, age, step, episode; /* age: steps since the newest sample used was taken */
    uint32_t started;
    int reason;                         /* of the last decision: NCS_GUARANTEED or why not */
    int broken, inside;
} ncs_filter;

#ifdef __cplusplus
extern "C" {
#endif
/* Starts an episode at step 0 and returns 1. It is a claim: that the error of this estimate lies in the plant's
   first_error. Returns 0, and everything stays off, if the table of numbers was altered. */
int ncs_start(ncs_filter *f, uint32_t episode, const double estimate[NCS_N]);
/* Takes in a sample and returns 1; 0 if it is of another episode, too old, ahead, not finite, or not newer than the
   newest one used. */
int ncs_receive(ncs_filter *f, uint32_t episode, uint32_t stamp, const double y[NCS_P]);
/* Decides the input of this step, from a proposal that is clipped to the limits; then the next step begins. */
int ncs_decide(ncs_filter *f, const double proposed[NCS_M], double u[NCS_M]);
/* Says what the actuator really applied of the last decision; to be called before the next ncs_receive. */
void ncs_applied(ncs_filter *f, const double u[NCS_M]);
#ifdef __cplusplus
}
#endif
#endif
