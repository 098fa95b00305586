/* Values and gradient of the mean effort by hand: what a core can do, for cpjax's reverse mode to be measured against.

   The loop is that of roofline.c, with the largest abs(x) as its only other metric. On the way forward each step keeps the state, sine, cosine
   and voltage; on the way back it computes the stages of the Runge-Kutta step once more and applies their transposes,
   in which the vector field has eight different derivatives. Derivatives are in the law's numbers and in those of its
   model, 16 together; the gate has none. Angles of later stages are by small rotations always.

   cc -O3 -march=native -ffp-contract=fast -shared -fPIC [-DBYTES=16|32|64] [-DVECTORS=n] gradient.c -o gradient.so     */

#include "roofline.c"

#include <stdlib.h>

/* What a step keeps of one vector of starts. */
typedef struct {
    vec x, x_dot, theta, theta_dot, sin, cos, voltage;
} kept;

/* Adjoints of the state. */
typedef struct {
    vec x, x_dot, theta, theta_dot;
} adjoint;

/* Derivatives in the law's numbers; same order in roofline.py. */
enum { GAIN, STIFFNESS, DAMPING, KICK, K0, K1, K2, K3, INERTIA, WEIGHT, ML, PIVOT_FRICTION, TOTAL, CART_FRICTION, MOTOR_DAMPING, FORCE, NUMBERS };

typedef struct {
    vec of[NUMBERS];
} numbers;

typedef struct {
    vec angle, x_dot, theta_dot, voltage;
} transposed;

/* Returns adjoints of the arguments of `acceleration` for those of its results. */
INLINE transposed transpose(const parameters *p, const constants *k, angle a, vec x_dot, vec theta_dot, vec voltage, pair out) {
    vec push = p->force_per_voltage * voltage - (p->damping + p->cart_friction) * x_dot - p->ml * theta_dot * theta_dot * a.sin;
    vec torque = p->weight * a.sin - p->pivot_friction * theta_dot;
    vec inverse = 1 / (k->fixed + k->turning * a.sin * a.sin), coupling = p->ml * a.cos;
    vec of_x = out.x * inverse, of_theta = out.theta * inverse;
    vec of_push = p->pivot_inertia * of_x + coupling * of_theta, of_torque = coupling * of_x + k->total * of_theta;
    vec of_coupling = torque * of_x + push * of_theta;
    vec of_inverse = of_x * (p->pivot_inertia * push + coupling * torque) + of_theta * (k->total * torque + coupling * push);
    vec of_sin = p->weight * of_torque - p->ml * theta_dot * theta_dot * of_push - 2 * k->turning * a.sin * inverse * of_inverse;
    return (transposed){
        of_sin * a.cos - p->ml * of_coupling * a.sin,
        -(p->damping + p->cart_friction) * of_push,
        -2 * p->ml * theta_dot * a.sin * of_push - p->pivot_friction * of_torque,
        p->force_per_voltage * of_push,
    };
}

/* Adds what an adjoint of the applied voltage means for the state and the law's numbers. */
INLINE void transpose_law(const parameters *p, const constants *k, const kept *b, vec of_voltage, adjoint *s, numbers *g) {
    const angle a = {b->sin, b->cos};
    const mask regulate = inside_gate(k, a.cos, b->theta_dot), free = magnitude(b->voltage) < p->limit;
    const vec of_demand = choose(free, of_voltage, all(0));
    const vec feedback = choose(regulate, of_demand, all(0)), of_swing = of_demand - feedback;
    s->x -= p->K[0] * feedback, s->x_dot -= p->K[1] * feedback;
    s->theta -= p->K[2] * feedback, s->theta_dot -= p->K[3] * feedback;
    g->of[K0] -= b->x * feedback, g->of[K1] -= b->x_dot * feedback;
    g->of[K2] -= wrap(b->theta) * feedback, g->of[K3] -= b->theta_dot * feedback;

    const vec rate = b->theta_dot, kinetic = R(0.5) * p->pivot_inertia * rate * rate;
    const vec energy = kinetic + p->weight * (a.cos - 1);
    const vec pump = -p->energy_gain * energy * rate * a.cos;
    const vec in = p->kick == 0 ? all(0) : largest(1 - (kinetic * k->per_weight + (1 + a.cos)) * k->per_edge, all(0));
    const vec near = in * in * in, hold = p->cart_stiffness * b->x + p->cart_damping * b->x_dot;
    const vec wanted = pump - (1 - near) * hold + near * p->kick;
    const vec torque = p->weight * a.sin - p->pivot_friction * rate, lever = p->ml * a.cos;
    const vec theta_ddot = (lever * wanted + torque) * k->per_inertia;
    const vec spun = a.sin * rate * rate;
    const vec force = k->total * wanted - lever * theta_ddot + p->ml * spun + p->cart_friction * b->x_dot;

    const vec of_force = of_swing * k->per_force, of_theta_ddot = -lever * of_force;
    const vec of_inner = of_theta_ddot * k->per_inertia; /* also the torque's */
    const vec of_wanted = k->total * of_force + lever * of_inner;
    vec of_lever = wanted * of_inner - theta_ddot * of_force;
    g->of[TOTAL] += wanted * of_force;
    g->of[CART_FRICTION] += b->x_dot * of_force, g->of[MOTOR_DAMPING] += b->x_dot * of_force;
    g->of[FORCE] -= (force + p->damping * b->x_dot) * k->per_force * of_force;
    g->of[INERTIA] -= theta_ddot * of_inner;
    g->of[ML] += a.cos * of_lever + spun * of_force;
    g->of[WEIGHT] += a.sin * of_inner;
    g->of[PIVOT_FRICTION] -= rate * of_inner;
    const vec of_near = of_wanted * (hold + p->kick), held = (1 - near) * of_wanted;
    g->of[STIFFNESS] -= b->x * held, g->of[DAMPING] -= b->x_dot * held, g->of[KICK] += near * of_wanted;
    g->of[GAIN] -= energy * rate * a.cos * of_wanted;
    const vec of_in = -3 * in * in * k->per_edge * of_near, of_energy = -p->energy_gain * rate * a.cos * of_wanted;
    const vec of_kinetic = of_energy + k->per_weight * of_in;
    g->of[WEIGHT] += (a.cos - 1) * of_energy - kinetic * k->per_weight * k->per_weight * of_in;
    g->of[INERTIA] += R(0.5) * rate * rate * of_kinetic;
    const vec of_cos = p->ml * of_lever - p->energy_gain * energy * rate * of_wanted + p->weight * of_energy + of_in;
    const vec of_sin = p->ml * rate * rate * of_force + p->weight * of_inner;
    s->x -= p->cart_stiffness * held;
    s->x_dot += (p->damping + p->cart_friction) * of_force - p->cart_damping * held;
    s->theta += of_sin * a.cos - of_cos * a.sin;
    s->theta_dot += 2 * p->ml * a.sin * rate * of_force - p->pivot_friction * of_inner
                    - p->energy_gain * energy * a.cos * of_wanted + p->pivot_inertia * rate * of_kinetic;
}

/* Transposes one step: the adjoint of the state after it becomes that of the state before it. */
INLINE void transpose_step(const parameters *p, const constants *k, const kept *b, adjoint *s, numbers *g) {
    const real dt = p->dt, half = R(0.5) * dt, sixth = dt / 6;
    const vec u = b->voltage, x_dot = b->x_dot, theta_dot = b->theta_dot;
    const angle a = {b->sin, b->cos};
    const pair a1 = acceleration(p, k, a, x_dot, theta_dot, u);
    const angle second = rotate(a, half * theta_dot);
    const vec x2 = x_dot + half * a1.x, t2 = theta_dot + half * a1.theta;
    const pair a2 = acceleration(p, k, second, x2, t2, u);
    const angle third = rotate(a, half * theta_dot + half * half * a1.theta);
    const vec x3 = x_dot + half * a2.x, t3 = theta_dot + half * a2.theta;
    const pair a3 = acceleration(p, k, third, x3, t3, u);
    const angle fourth = rotate(a, dt * theta_dot + half * dt * a2.theta);

    pair of1 = {sixth * (dt * s->x + s->x_dot), sixth * (dt * s->theta + s->theta_dot)};
    pair of2 = {sixth * (dt * s->x + 2 * s->x_dot), sixth * (dt * s->theta + 2 * s->theta_dot)};
    pair of3 = of2;
    const pair of4 = {sixth * s->x_dot, sixth * s->theta_dot};
    s->x_dot += dt * s->x, s->theta_dot += dt * s->theta;
    transposed t = transpose(p, k, fourth, x_dot + dt * a3.x, theta_dot + dt * a3.theta, u, of4);
    vec of_voltage = t.voltage + 2 * dt * u; /* the effort's own derivative */
    s->theta += t.angle, s->x_dot += t.x_dot, s->theta_dot += t.theta_dot + dt * t.angle;
    of3.x += dt * t.x_dot, of3.theta += dt * t.theta_dot, of2.theta += half * dt * t.angle;
    t = transpose(p, k, third, x3, t3, u, of3);
    of_voltage += t.voltage;
    s->theta += t.angle, s->x_dot += t.x_dot, s->theta_dot += t.theta_dot + half * t.angle;
    of2.x += half * t.x_dot, of2.theta += half * t.theta_dot, of1.theta += half * half * t.angle;
    t = transpose(p, k, second, x2, t2, u, of2);
    of_voltage += t.voltage;
    s->theta += t.angle, s->x_dot += t.x_dot, s->theta_dot += t.theta_dot + half * t.angle;
    of1.x += half * t.x_dot, of1.theta += half * t.theta_dot;
    t = transpose(p, k, a, x_dot, theta_dot, u, of1);
    of_voltage += t.voltage;
    s->theta += t.angle, s->x_dot += t.x_dot, s->theta_dot += t.theta_dot;
    transpose_law(p, k, b, of_voltage, s, g);
}

/* Starts: (4, n). Results: (2 + NUMBERS, n), the largest abs(x) of each start, its effort and the effort's derivatives.
   Returns 0, or 1 where memory is short. */
int gradient(const parameters *given, long n, long steps, const real *starts, real *results) {
    const parameters p = *given;
    const constants k = following(given);
    kept *tape = aligned_alloc(64, sizeof(kept) * VECTORS * (size_t)steps);
    if (!tape) return 1;
    const unsigned long before = flush_subnormals();
    for (long first = 0; first < n; first += LANES) {
        lanes block[VECTORS];
        adjoint adjoints[VECTORS];
        numbers found[VECTORS];
        memset(block, 0, sizeof block), memset(adjoints, 0, sizeof adjoints), memset(found, 0, sizeof found);
        for (int i = 0; i < LANES; i++) {
            long j = first + i < n ? first + i : n - 1;
            lanes *v = &block[i / WIDTH];
            v->x[i % WIDTH] = starts[j], v->x_dot[i % WIDTH] = starts[n + j];
            v->theta[i % WIDTH] = starts[2 * n + j], v->theta_dot[i % WIDTH] = starts[3 * n + j];
        }
        for (long step = 0; step < steps; step++)
            for (int i = 0; i < VECTORS; i++) {
                lanes *b = &block[i];
                const angle a = sin_cos(b->theta);
                b->voltage = applied(&p, &k, a, b, inside_gate(&k, a.cos, b->theta_dot));
                b->effort += p.dt * b->voltage * b->voltage;
                b->travel = largest(b->travel, magnitude(b->x));
                tape[step * VECTORS + i] = (kept){b->x, b->x_dot, b->theta, b->theta_dot, a.sin, a.cos, b->voltage};
                advance(&p, &k, b, a, acceleration(&p, &k, a, b->x_dot, b->theta_dot, b->voltage), 1);
            }
        for (long step = steps - 1; step >= 0; step--)
            for (int i = 0; i < VECTORS; i++)
                transpose_step(&p, &k, &tape[step * VECTORS + i], &adjoints[i], &found[i]);
        for (int i = 0; i < LANES && first + i < n; i++) {
            const int v = i / WIDTH, j = i % WIDTH;
            results[first + i] = largest(block[v].travel, magnitude(block[v].x))[j];
            results[n + first + i] = block[v].effort[j];
            for (int m = 0; m < NUMBERS; m++) results[(2 + m) * n + first + i] = found[v].of[m][j];
        }
    }
    restore(before);
    free(tape);
    return 0;
}
