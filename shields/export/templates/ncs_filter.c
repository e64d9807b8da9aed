/* Written by `ncs verify --c` from certificate @CERTIFICATE@
   of the plant with fingerprint @FINGERPRINT@. */
#include "ncs_filter.h"

#if defined __FAST_MATH__ || (defined __FINITE_MATH_ONLY__ && __FINITE_MATH_ONLY__)
#error "the filter compares numbers that may be NaN: compile it without -ffast-math"
#endif
#define STARTED 0x5afe100bu
typedef char ncs_a_double_must_have_64_bits[sizeof(double) == 8 ? 1 : -1];

/* Where the parts of the two tables begin. */
enum {
@OFFSETS@
};
static const uint64_t checksum = @CHECKSUM@u;
static const double table[TABLE_SIZE] = {
@TABLE@
};
static const ncs_real rows[ROWS_SIZE] = {
@ROWS@
};

/* FNV-1a over the bytes of a number, whatever their order in memory is. */
static uint64_t hashed(uint64_t hash, double number)
{
    uint64_t word = 0;
    int i;
    for (i = 0; i < 8; i++)
        ((unsigned char *)&word)[i] = ((const unsigned char *)&number)[i];
    for (i = 0; i < 64; i += 8)
        hash = (hash ^ ((word >> i) & 255u)) * 1099511628211u;
    return hash;
}

static int is_unaltered(void)
{
    static const int sizes[] = {NCS_N, NCS_M, NCS_P, NCS_H, NCS_ROWS};
    uint64_t hash = 14695981039346656037u;
    int i;
    for (i = 0; i < 5; i++)
        hash = hashed(hash, sizes[i]);
    for (i = 0; i < TABLE_SIZE; i++)
        hash = hashed(hash, table[i]);
    for (i = 0; i < ROWS_SIZE; i++)
        hash = hashed(hash, rows[i]);
    return hash == checksum;
}

static double size_of(double value) { return value < 0.0 ? -value : value; }
static int is_finite(double value) { return value - value == 0.0; }

static void copy(double *to, const double *from, uint32_t count)
{
    uint32_t i;
    for (i = 0; i < count; i++)
        to[i] = from[i];
}

/* sum + row v of a row that begins at `at`. */
static double dot(double sum, int at, int columns, const double *v)
{
    int j;
    for (j = 0; j < columns; j++)
        sum += table[at + j] * v[j];
    return sum;
}

static void lose(ncs_filter *f, int reason)
{
    if (!f->broken)
        f->broken = reason;
}

/* Rounding is bounded for estimates that are no farther out. */
static void look_at(ncs_filter *f, const double x[NCS_N])
{
    int i;
    for (i = 0; i < NCS_N; i++)
        if (!(size_of(x[i]) <= table[FAR + i]))
            lose(f, NCS_FAR_OUT);
}

static void predict(ncs_filter *f, double x[NCS_N], const double u[NCS_M])
{
    double next[NCS_N];
    int i;
    for (i = 0; i < NCS_N; i++)
        next[i] = dot(dot(0.0, A + i * NCS_N, NCS_N, x), B + i * NCS_M, NCS_M, u);
    copy(x, next, NCS_N);
    look_at(f, x);
}

/* Moves the base on by some steps, and the estimate from there to now. */
static void predict_from(ncs_filter *f, uint32_t steps)
{
    uint32_t i;
    f->count -= steps;
    for (i = 0; i < f->count; i++)
        copy(f->inputs[i], f->inputs[i + steps], NCS_M);
    copy(f->estimate, f->base, NCS_N);
    for (i = 0; i < f->count; i++)
        predict(f, f->estimate, f->inputs[i]);
}

int ncs_start(ncs_filter *f, uint32_t episode, const double estimate[NCS_N])
{
    int i;
    f->started = 0;
    f->reason = f->broken = NCS_STOPPED;
    if (!is_unaltered())
        return 0;
    copy(f->estimate, estimate, NCS_N);
    copy(f->base, estimate, NCS_N);
    f->count = f->age = f->step = 0;
    f->episode = episode;
    f->broken = NCS_GUARANTEED;
    f->inside = 1;
    for (i = 0; i < NCS_ROWS; i++)
        if (!(size_of(dot(0.0, G + i * NCS_N, NCS_N, estimate) - rows[MIDDLE + i]) <= table[START + i]))
            f->inside = 0;
    f->reason = f->inside ? NCS_GUARANTEED : NCS_NOT_KNOWN_INSIDE;
    look_at(f, estimate);
    f->started = STARTED;
    return 1;
}

int ncs_receive(ncs_filter *f, uint32_t episode, uint32_t stamp, const double y[NCS_P])
{
    double x[NCS_N], left[NCS_P];
    uint32_t age = f->step - stamp, back, gap, i; /* counted modulo 2^32; of a sample ahead it is large */
    int k;
    if (f->started != STARTED || episode != f->episode || age > NCS_H || age >= f->age)
        return 0;
    for (k = 0; k < NCS_P; k++)
        if (!is_finite(y[k])) {
            lose(f, NCS_NOT_FINITE);
            return 0;
        }
    gap = f->age - age;
    if (gap > NCS_H + 1) { /* no certified gain leads back from there */
        lose(f, NCS_LOST_CONTRACT);
        gap = NCS_H + 1;
    }
    back = f->count - age;
    copy(x, f->base, NCS_N);
    for (i = 0; i < back; i++)
        predict(f, x, f->inputs[i]);
    for (k = 0; k < NCS_P; k++) {
        left[k] = y[k] - dot(0.0, H + k * NCS_N, NCS_N, x);
        if (!(size_of(left[k]) <= table[ALARM + (int)(gap - 1) * NCS_P + k]))
            lose(f, NCS_ALARM);
    }
    for (k = 0; k < NCS_N; k++)
        f->base[k] = x[k] + dot(0.0, T + ((int)(gap - 1) * NCS_N + k) * NCS_P, NCS_P, left);
    look_at(f, f->base);
    f->age = age;
    predict_from(f, back);
    return 1;
}

/* The estimate and an input as the rows take them; returns what rounding takes off every limit. */
static ncs_real join(const ncs_filter *f, const double u[NCS_M], ncs_real z[NCS_N + NCS_M])
{
    double rounding = 0.0;
    int k;
    for (k = 0; k < NCS_N; k++) {
        z[k] = (ncs_real)f->estimate[k];
        rounding += table[ROUNDING + k] * size_of(f->estimate[k]);
    }
    for (k = 0; k < NCS_M; k++)
        z[NCS_N + k] = (ncs_real)u[k];
    return (ncs_real)rounding;
}

/* Where a row is after one step without error and disturbance, from the middle of its ends. */
static ncs_real center(int i, const ncs_real z[NCS_N + NCS_M])
{
    ncs_real sum = 0;
    int j;
    for (j = 0; j < NCS_N + NCS_M; j++)
        sum += rows[JOINT + i * (NCS_N + NCS_M) + j] * z[j];
    return sum - rows[MIDDLE + i];
}

/* Whether every state that one step can reach with u lies in the safe set. */
static int passes(const ncs_filter *f, const double u[NCS_M])
{
    ncs_real z[NCS_N + NCS_M], rounding = join(f, u, z);
    int i;
    for (i = 0; f->age <= NCS_H && i < NCS_ROWS; i++)
        if (!(size_of(center(i, z)) <= rows[LIMIT + (int)f->age * NCS_ROWS + i] - rounding))
            return 0;
    return f->age <= NCS_H;
}

/* Moves a single input to the closest one that passes, with a margin; what it returns is tested again. */
static void project(const ncs_filter *f, double u[NCS_M])
{
    static const double none[NCS_M] = {0.0};
    ncs_real z[NCS_N + NCS_M], rounding = join(f, none, z), gain, at, room, end[2];
    double low = table[LOW], high = table[HIGH];
    int i;
    for (i = 0; f->age <= NCS_H && i < NCS_ROWS; i++) {
        gain = rows[JOINT + i * (NCS_N + 1) + NCS_N];
        if (gain == 0)
            continue;
        at = center(i, z);
        room = rows[LIMIT + (int)f->age * NCS_ROWS + i] - 3 * rounding - (ncs_real)NCS_MARGIN;
        end[gain < 0] = (-room - at) / gain;
        end[gain > 0] = (room - at) / gain;
        low = end[0] > low ? end[0] : low;
        high = end[1] < high ? end[1] : high;
    }
    if (low <= high)
        u[0] = u[0] < low ? low : u[0] > high ? high : u[0];
}

int ncs_decide(ncs_filter *f, const double proposed[NCS_M], double u[NCS_M])
{
    int k, decision = NCS_SAFE, proved;
    if (f->started != STARTED) {
        f->reason = NCS_STOPPED;
        for (k = 0; k < NCS_M; k++)
            u[k] = 0.0;
        return NCS_NOT_STARTED;
    }
    f->reason = f->broken ? f->broken : !f->inside ? NCS_NOT_KNOWN_INSIDE
              : f->age > NCS_H ? NCS_OLD_SAMPLE : NCS_GUARANTEED;
    for (k = 0; k < NCS_M; k++) {
        u[k] = proposed[k] < table[LOW + k] ? table[LOW + k] : proposed[k];
        u[k] = u[k] > table[HIGH + k] ? table[HIGH + k] : u[k];
        if (!is_finite(proposed[k]))
            decision = NCS_INVALID;
    }
    proved = decision == NCS_SAFE && passes(f, u);
    if (decision == NCS_SAFE && !proved) {
        decision = NCS_PROJECTED;
        if (NCS_M == 1) {
            project(f, u);
            proved = passes(f, u);
        }
    }
    if (!proved) {
        decision = decision == NCS_INVALID ? NCS_INVALID : NCS_FALLBACK;
        for (k = 0; k < NCS_M; k++) {
            u[k] = dot(table[CONSTANT + k], K + k * NCS_N, NCS_N, f->estimate);
            u[k] = !is_finite(u[k]) ? 0.0 : u[k] < table[LOW + k] ? table[LOW + k]
                 : u[k] > table[HIGH + k] ? table[HIGH + k] : u[k];
        }
        proved = passes(f, u);
    }
    f->inside = proved || (f->inside && f->age <= NCS_H); /* of the next step: the fallback keeps what is inside */
    if (f->count > NCS_H) {
        predict(f, f->base, f->inputs[0]);
        predict_from(f, 1);
    }
    copy(f->inputs[f->count++], u, NCS_M);
    predict(f, f->estimate, u);
    f->step++;
    f->age += f->age < UINT32_MAX;
    return decision;
}

void ncs_applied(ncs_filter *f, const double u[NCS_M])
{
    int k, differs = 0, finite = 1;
    if (f->started != STARTED)
        return;
    for (k = 0; k < NCS_M; k++) {
        differs |= f->count == 0 || f->inputs[f->count - 1][k] != u[k];
        finite &= is_finite(u[k]);
    }
    if (!differs)
        return;
    lose(f, NCS_OTHER_INPUT);
    if (finite && f->count > 0) {
        copy(f->inputs[f->count - 1], u, NCS_M);
        predict_from(f, 0);
    }
}
