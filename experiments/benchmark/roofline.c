/* The closed loop of cpjax by hand: what a core can do, for cpjax to be measured against.

   Plant, law, clock, integrator, metrics and flags are those of cpjax: classical Runge-Kutta with the position rows
   eliminated, control held over a step, energy swing-up with a kick, state feedback, a gate in angle and rate, the
   protocol's metrics. One sine and cosine of full accuracy (2 ulp) a step; the three later stage angles by small
   rotations, or in full where a start turns too fast for them. A block of LANES starts stays in the first cache for
   the whole run, and is worked on a vector of BYTES at a time (GCC's and Clang's vector extensions). In two
   formulations: all vectors of a block are observed, then all advance (two passes), or each does both at once (FUSED,
   one pass). Which is faster depends on the processor: roofline.py times them all.

   cc -O3 -march=native -ffp-contract=fast -fopenmp -shared -fPIC
      [-DSINGLE] [-DFUSED] [-DBYTES=16|32|64] [-DVECTORS=n] roofline.c -o roofline.so                                      */

#include <math.h>
#include <stdint.h>
#include <string.h>
#if defined __AVX__
#include <immintrin.h>
#endif

#ifndef BYTES /* of a vector; the compiler splits it where the machine has shorter ones */
#if defined __AVX512F__
#define BYTES 64
#elif defined __AVX__
#define BYTES 32
#else
#define BYTES 16
#endif
#endif
#ifndef VECTORS
#define VECTORS 16 /* in a block */
#endif

#ifdef SINGLE
typedef float real;
typedef int32_t word;
#define R(x) x##f
#define SHIFTER 12582912.0f /* 1.5 * 2^23: adding it rounds to a whole number, which the low bits then hold */
#define EPS 1.1920928955078125e-7f
#else
typedef double real;
typedef int64_t word;
#define R(x) x
#define SHIFTER 6755399441055744.0
#define EPS 2.220446049250313e-16
#endif

typedef real vec __attribute__((vector_size(BYTES)));
typedef word mask __attribute__((vector_size(BYTES))); /* also whole numbers */
#define WIDTH ((int)(BYTES / sizeof(real)))
#define LANES (VECTORS * WIDTH)
#define INLINE static inline __attribute__((always_inline))

/* Sets subnormal numbers to zero in this thread, as XLA does: products of settled states are among them, and slow.
   Returns what the processor's register was, for `restore`. */
INLINE unsigned long flush_subnormals(void) {
#if defined __AVX__
    const unsigned before = _mm_getcsr();
    _mm_setcsr(before | 0x8040);
    return before;
#elif defined __aarch64__
    unsigned long before;
    __asm__ volatile("mrs %0, fpcr" : "=r"(before));
    __asm__ volatile("msr fpcr, %0" : : "r"(before | 1ul << 24));
    return before;
#else
    return 0;
#endif
}

INLINE void restore(unsigned long before) {
#if defined __AVX__
    _mm_setcsr((unsigned)before);
#elif defined __aarch64__
    __asm__ volatile("msr fpcr, %0" : : "r"(before));
#else
    (void)before;
#endif
}

INLINE vec choose(mask m, vec a, vec b) {
#if BYTES == 64 && defined __AVX512DQ__ && defined SINGLE
    return (vec)_mm512_mask_blend_ps(_mm512_movepi32_mask((__m512i)m), (__m512)b, (__m512)a);
#elif BYTES == 64 && defined __AVX512DQ__
    return (vec)_mm512_mask_blend_pd(_mm512_movepi64_mask((__m512i)m), (__m512d)b, (__m512d)a);
#elif BYTES == 32 && defined __AVX__ && defined SINGLE
    return (vec)_mm256_blendv_ps((__m256)b, (__m256)a, (__m256)m);
#elif BYTES == 32 && defined __AVX__
    return (vec)_mm256_blendv_pd((__m256d)b, (__m256d)a, (__m256d)m);
#else
    return (vec)((m & (mask)a) | (~m & (mask)b));
#endif
}

/* As in JAX, NaN if one of them is; where that matters, the sum of all is looked at. */
INLINE vec largest(vec a, vec b) {
#if BYTES == 64 && defined __AVX512F__ && defined SINGLE
    return (vec)_mm512_max_ps((__m512)a, (__m512)b);
#elif BYTES == 64 && defined __AVX512F__
    return (vec)_mm512_max_pd((__m512d)a, (__m512d)b);
#elif BYTES == 32 && defined __AVX__ && defined SINGLE
    return (vec)_mm256_max_ps((__m256)a, (__m256)b);
#elif BYTES == 32 && defined __AVX__
    return (vec)_mm256_max_pd((__m256d)a, (__m256d)b);
#else
    return choose(a > b, a, b);
#endif
}

INLINE vec smallest(vec a, vec b) { return -largest(-a, -b); }
INLINE vec magnitude(vec a) { return (vec)((mask)a & (word)(~((uint64_t)1 << (8 * sizeof(word) - 1)))); }
INLINE vec all(real a) { return a - (vec){0}; }

enum { RUNAWAY = 1, NON_FINITE = 2, CHATTERING = 4, STOPPED = RUNAWAY | NON_FINITE, CHATTER_LENGTH = 8 };

/* Same order in roofline.py. */
typedef struct {
    real dt;
    real mass, pole_mass, ml, weight, pivot_inertia, pole_inertia, pole_length, cart_friction, pivot_friction;
    real force_per_voltage, damping, limit;
    real energy_gain, cart_stiffness, cart_damping, kick, kick_edge; /* kick_edge = 2 sin(radius / 2)^2 */
    real K[4];
    real gate_edge, gate_rate; /* gate_edge = 2 sin(half_angle / 2)^2 */
    real angle_band, position_band, hold;
} parameters;

/* What follows from the parameters, once. */
typedef struct {
    real total, fixed, turning, per_weight, per_edge, per_gate_edge, per_gate_rate, per_inertia, per_force;
} constants;

/* Returns what follows from the parameters. */
INLINE constants following(const parameters *p) {
    return (constants){
        .total = p->mass + p->pole_mass,
        .fixed = (p->mass + p->pole_mass) * p->pole_inertia + p->ml * p->pole_length * p->mass,
        .turning = p->ml * p->pole_length * p->pole_mass,
        .per_weight = 1 / p->weight,
        .per_edge = 1 / p->kick_edge,
        .per_gate_edge = 1 / p->gate_edge,
        .per_gate_rate = 1 / p->gate_rate,
        .per_inertia = 1 / p->pivot_inertia,
        .per_force = 1 / p->force_per_voltage,
    };
}

/* One vector of starts. */
typedef struct {
    vec x, x_dot, theta, theta_dot, voltage;
    vec entered, travel, effort, variation, peak_voltage, peak_acceleration;
    mask mode, flag, changes, switches;
} lanes;

typedef struct {
    vec sin, cos;
} angle;

typedef struct {
    vec x, theta;
} pair;

/* Range reduction of Cody and Waite; kernels of fdlibm (double) and Cephes (single): see cpjax/backend/trigonometry.py
   for their notices. */
INLINE angle sin_cos(vec theta) {
    vec shifted = theta * R(0.63661977236758134308) + SHIFTER, n = shifted - SHIFTER;
#ifdef SINGLE
    vec r = ((theta - n * 1.5703125f) - n * 4.837512969970703125e-4f) - n * 7.54978995489188216e-8f;
    vec z = r * r;
    vec s = r + r * z * (-1.6666654611e-1f + z * (8.3321608736e-3f + z * -1.9515295891e-4f));
    vec c = 1 - (0.5f * z - z * z * (4.166664568298827e-2f + z * (-1.388731625493765e-3f + z * 2.443315711809948e-5f)));
#else
    vec r = ((theta - n * 1.57079632673412561417e00) - n * 6.07710050630396597660e-11) - n * 2.02226624879595063154e-21;
    vec z = r * r;
    vec s = r + r * z * (-1.66666666666666324348e-01 + z * (8.33333333332248946124e-03 + z * (-1.98412698298579493134e-04
            + z * (2.75573137070700676789e-06 + z * (-2.50507602534068634195e-08 + z * 1.58969099521155010221e-10)))));
    vec c = 1 - (0.5 * z - z * z * (4.16666666666666019037e-02 + z * (-1.38888888888741095749e-03
            + z * (2.48015872894767294178e-05 + z * (-2.75573143513906633035e-07 + z * (2.08757232129817482790e-09
            + z * -1.13596475577881948265e-11))))));
#endif
    mask q = (mask)shifted, odd = (q & 1) != 0;
    const int top = 8 * sizeof(word) - 2; /* moves bit 1 of a number to the sign */
    mask sin_sign = (q & 2) << top, cos_sign = ((q + 1) & 2) << top;
    return (angle){(vec)((mask)choose(odd, c, s) ^ sin_sign), (vec)((mask)choose(odd, s, c) ^ cos_sign)};
}

/* Of base + d, |d| <= 0.1. */
INLINE angle rotate(angle base, vec d) {
    vec z = d * d;
#ifdef SINGLE
    vec s = d + d * z * (R(-1.0) / 6 + z * (R(1.0) / 120));
    vec c1 = z * (R(-0.5) + z * (R(1.0) / 24));
#else
    vec s = d + d * z * (-1.0 / 6 + z * (1.0 / 120 + z * (-1.0 / 5040 + z * (1.0 / 362880))));
    vec c1 = z * (-0.5 + z * (1.0 / 24 + z * (-1.0 / 720 + z * (1.0 / 40320))));
#endif
    return (angle){base.sin + (base.sin * c1 + base.cos * s), base.cos + (base.cos * c1 - base.sin * s)};
}

INLINE pair acceleration(const parameters *p, const constants *k, angle a, vec x_dot, vec theta_dot, vec voltage) {
    vec force = p->force_per_voltage * voltage - p->damping * x_dot;
    vec push = force - p->cart_friction * x_dot - p->ml * theta_dot * theta_dot * a.sin;
    vec torque = p->weight * a.sin - p->pivot_friction * theta_dot;
    vec inverse = 1 / (k->fixed + k->turning * a.sin * a.sin), coupling = p->ml * a.cos;
    return (pair){(p->pivot_inertia * push + coupling * torque) * inverse, (k->total * torque + coupling * push) * inverse};
}

INLINE vec wrap(vec theta) {
    vec turns = (theta * R(0.15915494309189533577) + SHIFTER) - SHIFTER;
    return theta - turns * R(6.283185307179586477);
}

INLINE mask inside_gate(const constants *k, vec cos, vec theta_dot) {
    vec rate = theta_dot * k->per_gate_rate;
    return 1 - (1 - cos) * k->per_gate_edge - rate * rate >= 0;
}

INLINE vec applied(const parameters *p, const constants *k, angle a, const lanes *b, mask regulate) {
    vec feedback = -(p->K[0] * b->x + p->K[1] * b->x_dot + p->K[2] * wrap(b->theta) + p->K[3] * b->theta_dot);
    vec kinetic = R(0.5) * p->pivot_inertia * b->theta_dot * b->theta_dot;
    vec energy = kinetic + p->weight * (a.cos - 1);
    vec pump = -p->energy_gain * energy * b->theta_dot * a.cos;
    vec in = largest(1 - (kinetic * k->per_weight + (1 + a.cos)) * k->per_edge, all(0));
    vec near = p->kick == 0 ? all(0) : in * in * in;
    vec wanted = pump - (1 - near) * (p->cart_stiffness * b->x + p->cart_damping * b->x_dot) + near * p->kick;
    vec torque = p->weight * a.sin - p->pivot_friction * b->theta_dot;
    vec theta_ddot = (p->ml * a.cos * wanted + torque) * k->per_inertia;
    vec force = k->total * wanted - p->ml * a.cos * theta_ddot + p->ml * a.sin * b->theta_dot * b->theta_dot
                + p->cart_friction * b->x_dot;
    vec swing = (force + p->damping * b->x_dot) * k->per_force;
    return smallest(largest(choose(regulate, feedback, swing), all(-p->limit)), all(p->limit));
}

/* What happens at one instant: the controller is read and the metrics take their sample. */
INLINE pair observe(const parameters *p, const constants *k, lanes *b, angle a, real time, real elapsed) {
    mask mode = inside_gate(k, a.cos, b->theta_dot);
    vec before = b->voltage, voltage = applied(p, k, a, b, mode);
    mask changed = mode != b->mode;
    b->changes = (b->changes + 1) & changed;
    b->flag |= (b->changes >= CHATTER_LENGTH) & CHATTERING;
    pair rates = acceleration(p, k, a, b->x_dot, b->theta_dot, voltage);
    vec passed = choose((b->flag & STOPPED) != 0, all(0), all(elapsed));
    mask inside = (magnitude(wrap(b->theta)) <= p->angle_band) & (magnitude(b->x) <= p->position_band);
    b->entered = choose(inside, smallest(b->entered, all(time)), all(INFINITY));
    b->travel = largest(b->travel, magnitude(b->x));
    b->effort += passed * before * before;
    b->variation += magnitude(voltage - before);
    b->peak_voltage = largest(b->peak_voltage, magnitude(voltage));
    b->peak_acceleration = largest(b->peak_acceleration, magnitude(rates.x));
    b->switches -= changed; /* a true mask is -1 */
    b->mode = mode;
    b->voltage = voltage;
    return rates;
}

INLINE void advance(const parameters *p, const constants *k, lanes *b, angle a, pair a1, int rotations) {
    real dt = p->dt, half = R(0.5) * dt, sixth = dt / 6;
    vec u = b->voltage, d = half * b->theta_dot;
    angle next = rotations ? rotate(a, d) : sin_cos(b->theta + d);
    pair a2 = acceleration(p, k, next, b->x_dot + half * a1.x, b->theta_dot + half * a1.theta, u);
    d = half * b->theta_dot + half * half * a1.theta;
    next = rotations ? rotate(a, d) : sin_cos(b->theta + d);
    pair a3 = acceleration(p, k, next, b->x_dot + half * a2.x, b->theta_dot + half * a2.theta, u);
    d = dt * b->theta_dot + half * dt * a2.theta;
    next = rotations ? rotate(a, d) : sin_cos(b->theta + d);
    pair a4 = acceleration(p, k, next, b->x_dot + dt * a3.x, b->theta_dot + dt * a3.theta, u);
    pair inner = {a2.x + a3.x, a2.theta + a3.theta};
    vec x = b->x + dt * b->x_dot + dt * sixth * (a1.x + inner.x);
    vec theta = b->theta + dt * b->theta_dot + dt * sixth * (a1.theta + inner.theta);
    vec x_dot = b->x_dot + sixth * (a1.x + 2 * inner.x + a4.x);
    vec theta_dot = b->theta_dot + sixth * (a1.theta + 2 * inner.theta + a4.theta);
    vec ahead = largest(magnitude(b->x_dot + dt * a1.x), magnitude(b->theta_dot + dt * a1.theta));
    vec fastest = largest(magnitude(x), largest(magnitude(x_dot), magnitude(theta_dot)));
    vec sum = ahead + x + x_dot + theta + theta_dot;
    mask finite = sum - sum == 0, stopped = (b->flag & STOPPED) != 0;
    mask good = ~stopped & finite & (ahead <= R(1e3)) & (fastest <= R(1e3)) & (magnitude(theta) <= R(1e5));
    b->x = choose(good, x, b->x);
    b->x_dot = choose(good, x_dot, b->x_dot);
    b->theta = choose(good, theta, b->theta);
    b->theta_dot = choose(good, theta_dot, b->theta_dot);
    b->flag |= ~(stopped | good) & ((finite & RUNAWAY) | (~finite & NON_FINITE));
}

/* Whether no lane turns so fast that its angle may change by more than 0.1 in a step. The bound is half of that, as a
   step may speed the pole up. */
INLINE int slow(vec theta_dot, real dt) {
    vec turn = magnitude(theta_dot) * dt;
    mask fast = ~(turn <= R(0.05));
    word any = 0;
    for (int j = 0; j < WIDTH; j++) any |= fast[j];
    return !any;
}

static void simulate(const parameters *p, const constants *k, long steps, lanes *block) {
    for (int i = 0; i < VECTORS; i++) {
        lanes *b = &block[i];
        angle a = sin_cos(b->theta);
        b->mode = inside_gate(k, a.cos, b->theta_dot);
        b->voltage = applied(p, k, a, b, b->mode);
        b->entered = all(INFINITY);
    }
#ifndef FUSED
    angle angles[VECTORS];
    pair rates[VECTORS];
#endif
    for (long step = 0; step < steps; step++) {
        real time = (real)step * p->dt, elapsed = step > 0 ? p->dt : 0;
#ifdef FUSED
        for (int i = 0; i < VECTORS; i++) {
            angle a = sin_cos(block[i].theta);
            pair rates = observe(p, k, &block[i], a, time, elapsed);
            if (slow(block[i].theta_dot, p->dt))
                advance(p, k, &block[i], a, rates, 1);
            else
                advance(p, k, &block[i], a, rates, 0);
        }
#else
        vec fastest = {0};
        for (int i = 0; i < VECTORS; i++) fastest = largest(fastest, magnitude(block[i].theta_dot));
        for (int i = 0; i < VECTORS; i++) {
            angles[i] = sin_cos(block[i].theta);
            rates[i] = observe(p, k, &block[i], angles[i], time, elapsed);
        }
        if (slow(fastest, p->dt))
            for (int i = 0; i < VECTORS; i++) advance(p, k, &block[i], angles[i], rates[i], 1);
        else
            for (int i = 0; i < VECTORS; i++) advance(p, k, &block[i], angles[i], rates[i], 0);
#endif
    }
    for (int i = 0; i < VECTORS; i++)
        observe(p, k, &block[i], sin_cos(block[i].theta), (real)steps * p->dt, steps > 0 ? p->dt : 0);
}

/* Starts: (4, n). Results: (9, n), in the order of cpjax.Metrics, as real numbers. */
void roofline(const parameters *given, long n, long steps, const real *starts, real *results, int threads) {
    const parameters p = *given;
    const constants k = following(given);
    const real end = (real)steps * p.dt;
    const long blocks = (n + LANES - 1) / LANES;
#pragma omp parallel for schedule(dynamic, 1) num_threads(threads)
    for (long block = 0; block < blocks; block++) {
        const unsigned long before = flush_subnormals();
        lanes b[VECTORS];
        const long first = block * LANES, count = n - first < LANES ? n - first : LANES;
        memset(b, 0, sizeof b);
        for (int i = 0; i < LANES; i++) {
            long j = first + (i < count ? i : count - 1);
            lanes *v = &b[i / WIDTH];
            v->x[i % WIDTH] = starts[j], v->x_dot[i % WIDTH] = starts[n + j];
            v->theta[i % WIDTH] = starts[2 * n + j], v->theta_dot[i % WIDTH] = starts[3 * n + j];
        }
        simulate(&p, &k, steps, b);
        for (int i = 0; i < count; i++) {
            const lanes *v = &b[i / WIDTH];
            const int j = i % WIDTH;
            real settling = (v->flag[j] & STOPPED) ? INFINITY : v->entered[j];
            real row[9] = {settling <= end - p.hold + 64 * EPS * end, settling, v->travel[j], v->effort[j],
                           v->variation[j], v->peak_voltage[j], v->peak_acceleration[j], (real)v->switches[j],
                           (real)v->flag[j]};
            for (int r = 0; r < 9; r++) results[r * n + first + i] = row[r];
        }
        restore(before);
    }
}
