/* Local search from one point, next to the gradient: projected L-BFGS and ADADELTA.

   Standard C, libm only, no allocation, no globals. Before this file stands N_ACTIONS, the number of stacked actions.
   A walk says where it wants to be evaluated next, and is told value and gradient there. interpreted.py does the same, step
   for step, where there is no compiler: change both.
   Bounds are low[N_ACTIONS], high[N_ACTIONS]; an action with low == high is held. */

enum outcome { UNDER_WAY = -1, CONVERGED, ITERATION_LIMIT, OSCILLATION, STALLED, NOT_FINITE, TIME_LIMIT };

#define PAIRS (N_ACTIONS < 8 ? (N_ACTIONS > 0 ? N_ACTIONS : 1) : 8) /* curvature pairs that L-BFGS keeps */

#define FIRST_STEP 0.05     /* [range] no curvature is known yet */
#define LONGEST_STEP 0.5    /* [range] no step crosses more than half of it */
#define ARMIJO 1e-4         /* sufficient decrease: Nocedal & Wright 2006, equation 3.4 */
#define CURVATURE 0.9       /* how much flatter a step must end: equation 3.6b there */
#define LOOSE 1e3           /* times the tolerance: converged where rounding hides all further gain */
#define HIDDEN 10           /* times the smallest gain: so far below the best so far slopes decide */
#define DECREASE 0.1        /* there slopes decide: Hager & Zhang 2005, equation 4.1 */
#define MOST_ROUNDS 10         /* of sending actions to their bounds */
#define MOST_TRIES 50          /* steps of one line search */
#ifdef SINGLE
#define SMALLEST_GAIN 1e-6 /* relative to the value: less cannot be told from rounding */
#else
#define SMALLEST_GAIN 1e-15
#endif

/* The last steps and gradient changes, in a ring. */
struct pairs {
  double *s, *y; /* PAIRS times N_ACTIONS */
  int stored, newest;
};

/* Where the k-th newest pair begins. */
static int nth(const struct pairs *pairs, int k) { return (pairs->newest - k + PAIRS) % PAIRS * N_ACTIONS; }

static double dot(const double *a, const double *b, const double *mask) {
  double sum = 0;
  int i;
  for (i = 0; i < N_ACTIONS; ++i) sum += mask[i] * a[i] * b[i];
  return sum;
}

static double larger(double a, double b) { return a > b ? a : b; }
static double smaller(double a, double b) { return a < b ? a : b; }

static double largest(const double *a) {
  double found = 0;
  int i;
  for (i = 0; i < N_ACTIONS; ++i) found = larger(found, fabs(a[i]));
  return found;
}

/* x = low + (high - low) u, which rounding must not carry past a bound. */
static void place(const double *u, const double *low, const double *high, double *x) {
  int i;
  for (i = 0; i < N_ACTIONS; ++i) x[i] = smaller(larger(low[i] + (high[i] - low[i]) * u[i], low[i]), high[i]);
}

/* d = -H g within the actions of the mask, by the two-loop recursion over the curvature pairs, newest first (Nocedal &
   Wright 2006, algorithm 7.4). */
static void quasi_newton(const struct pairs *pairs, const double *g, const double *mask, double *d) {
  double alpha[PAIRS] = {0}, rho[PAIRS] = {0}, scale = 1;
  int i, k;
  for (i = 0; i < N_ACTIONS; ++i) d[i] = -mask[i] * g[i];
  for (k = 0; k < pairs->stored; ++k) {
    const double *s = pairs->s + nth(pairs, k), *y = pairs->y + nth(pairs, k);
    double sy = dot(s, y, mask);
    rho[k] = sy > 1e-12 * sqrt(dot(s, s, mask) * dot(y, y, mask)) ? 1 / sy : 0;
    alpha[k] = rho[k] * dot(s, d, mask);
    for (i = 0; i < N_ACTIONS; ++i) d[i] -= alpha[k] * mask[i] * y[i];
  }
  for (k = 0; k < pairs->stored; ++k) { /* the newest pair that can be used sets the scale */
    const double *y = pairs->y + nth(pairs, k);
    if (rho[k] > 0) {
      scale = 1 / (rho[k] * dot(y, y, mask));
      break;
    }
  }
  for (i = 0; i < N_ACTIONS; ++i) d[i] *= scale;
  for (k = pairs->stored - 1; k >= 0; --k) {
    const double *s = pairs->s + nth(pairs, k), *y = pairs->y + nth(pairs, k);
    double beta = rho[k] * dot(y, d, mask);
    for (i = 0; i < N_ACTIONS; ++i) d[i] += (alpha[k] - beta) * mask[i] * s[i];
  }
}

/* The same, but actions that it would carry past a bound go to that bound, and the others do without them: clipping the
   step afterwards can leave no descent (Bertsekas 1982). The mask loses those actions. Returns the slope along d. */
static double direction(const struct pairs *pairs, const double *u, const double *g, double *mask, double *d,
                        double *to_bound) {
  double slope = 0;
  int i, hits = 1, rounds;
  for (i = 0; i < N_ACTIONS; ++i) to_bound[i] = 0;
  for (rounds = 0; rounds < MOST_ROUNDS && hits; ++rounds) {
    hits = 0;
    quasi_newton(pairs, g, mask, d);
    for (i = 0; i < N_ACTIONS; ++i) {
      double end = u[i] + d[i];
      if (mask[i] > 0 && (end < 0 || end > 1)) {
        if (d[i] * g[i] < 0) to_bound[i] = (end < 0 ? 0 : 1) - u[i];
        mask[i] = 0;
        hits = 1;
      }
    }
  }
  for (i = 0; i < N_ACTIONS; ++i) {
    if (mask[i] == 0) d[i] = to_bound[i];
    slope += g[i] * d[i];
  }
  return slope;
}

/* What all walks of a search share. */
struct settings {
  const double *low, *high;
  long long limit;    /* gradients of one walk */
  int ascends;        /* by ADADELTA, else L-BFGS */
  double decay, epsilon;
  int oscillation, scaled, keep_best;
  const volatile int *stop; /* not 0 once time is over */
};

/* One point on its way. */
struct walk {
  long start; /* the number of its start point */
  double tolerance, scale;
  double *history; /* J at each gradient on the way; 0 where nobody asks */
  long long spent, limit;
  int begun, outcome;
  double value;
  double x[N_ACTIONS + 1]; /* where it wants to be evaluated; at the end, where it has ended */
  /* of L-BFGS, which minimises f = -J over u = (x - low) / (high - low) */
  struct pairs pairs;
  double s[PAIRS * N_ACTIONS + 1], y[PAIRS * N_ACTIONS + 1];
  double u[N_ACTIONS + 1], g[N_ACTIONS + 1], d[N_ACTIONS + 1], trial[N_ACTIONS + 1], u_low[N_ACTIONS + 1], g_low[N_ACTIONS + 1];
  double f, f_low, descent, longest, slope, predicted;
  double t, t_low, t_high; /* steps between which the line search looks */
  int fresh, flat, tries, doubted;
  double best[N_ACTIONS + 1], best_value; /* of L-BFGS a point u, of ADADELTA a point x */
  double flattest;                        /* the smallest slope so far */
  /* of ADADELTA, of which u is the last point, g the gradient there */
  double mean_square[N_ACTIONS + 1], mean_move[N_ACTIONS + 1];
  int falls;
  double scratch[3][N_ACTIONS + 1]; /* here, since the stack may be small */
};

static void remember(struct walk *k, double value) {
  if (k->history) k->history[k->spent] = value;
  ++k->spent;
}

/* Take the best step of the line search. */
static void accept(struct walk *k, double noise) {
  double *const step = k->scratch[0], *const change = k->scratch[1], sy = 0, ss = 0, yy = 0;
  int i;
  for (i = 0; i < N_ACTIONS; ++i) {
    step[i] = k->u_low[i] - k->u[i];
    change[i] = k->g_low[i] - k->g[i];
    sy += step[i] * change[i];
    ss += step[i] * step[i];
    yy += change[i] * change[i];
  }
  if (sy > 1e-12 * sqrt(ss * yy)) {
    k->pairs.newest = (k->pairs.newest + 1) % PAIRS;
    if (k->pairs.stored < PAIRS) ++k->pairs.stored;
    for (i = 0; i < N_ACTIONS; ++i) {
      k->pairs.s[nth(&k->pairs, 0) + i] = step[i];
      k->pairs.y[nth(&k->pairs, 0) + i] = change[i];
    }
  }
  if (k->f - k->f_low > noise)
    k->flat = k->doubted = 0;
  else if (k->tries == 1 || k->doubted)
    ++k->flat;
  k->f = k->f_low;
  for (i = 0; i < N_ACTIONS; ++i) {
    k->u[i] = k->u_low[i];
    k->g[i] = k->g_low[i];
    if (-k->f > k->best_value) k->best[i] = k->u[i];
  }
  k->best_value = larger(k->best_value, -k->f);
  k->fresh = 1;
}

/* Say where to look next; 0 if the climb has ended. */
static int climb_on(struct walk *k, const struct settings *set) {
  const double *low = set->low, *high = set->high;
  int i;
  if (*set->stop) {
    k->limit = k->spent;
    k->outcome = TIME_LIMIT;
  }
  if (k->fresh) {
    double *const mask = k->scratch[0], *const free = k->scratch[1], *const to_bound = k->scratch[2];
    k->slope = 0;
    for (i = 0; i < N_ACTIONS; ++i) {
      int held = high[i] <= low[i] || (k->u[i] <= 0 && k->g[i] > 0) || (k->u[i] >= 1 && k->g[i] < 0);
      free[i] = mask[i] = held ? 0 : 1;
      k->slope = larger(k->slope, mask[i] * fabs(k->g[i]));
    }
    if (k->slope <= k->tolerance) {
      k->outcome = CONVERGED;
      return 0;
    }
    if (k->slope < k->flattest / 2) { /* a gain that values are too coarse for */
      k->flattest = k->slope;
      k->flat = 0;
    }
    k->descent = direction(&k->pairs, k->u, k->g, mask, k->d, to_bound);
    if (k->pairs.stored && k->descent < 0 && -k->descent <= SMALLEST_GAIN * fabs(k->f) && k->slope <= LOOSE * k->tolerance) {
      k->outcome = CONVERGED; /* rounding would hide what is left to gain */
      return 0;
    }
    if (k->pairs.stored == 0 || !(k->descent < 0)) { /* nothing known of the curvature: along the gradient */
      k->descent = 0;
      for (i = 0; i < N_ACTIONS; ++i) {
        k->d[i] = -free[i] * k->g[i] * (FIRST_STEP / k->slope);
        k->descent += k->g[i] * k->d[i];
      }
    }
    k->longest = largest(k->d);
    k->t = k->longest > LONGEST_STEP ? LONGEST_STEP / k->longest : 1;
    k->t_low = 0;
    k->t_high = INFINITY;
    k->tries = 0;
    k->fresh = 0;
  }
  if (k->spent >= k->limit) {
    if (k->t_low > 0) accept(k, SMALLEST_GAIN * fabs(k->f));
    return 0;
  }
  k->predicted = 0;
  for (i = 0; i < N_ACTIONS; ++i) {
    k->trial[i] = smaller(larger(k->u[i] + k->t * k->d[i], 0), 1);
    k->predicted += k->g[i] * (k->trial[i] - k->u[i]);
  }
  place(k->trial, low, high, k->x);
  return 1;
}

/* Climb by projected L-BFGS (Liu & Nocedal 1989): take in value and gradient at x, and say where to look next; 0 at the end.
   The line search brackets a step that satisfies the weak Wolfe conditions, with which BFGS also gets past kinks (Lewis &
   Overton 2013). */
static int climb(struct walk *k, const struct settings *set, double value, double *g_trial) {
  double f_trial = -value, check = 0, slope_trial = 0, noise;
  int i, finite, gained, accepted = 0;
  for (i = 0; i < N_ACTIONS; ++i) {
    g_trial[i] *= -(set->high[i] - set->low[i]);
    check += g_trial[i];
  }
  finite = isfinite(value) && isfinite(check);
  if (!k->begun) {
    k->begun = 1;
    remember(k, finite ? value : -INFINITY);
    k->f = finite ? f_trial : INFINITY;
    k->outcome = finite ? ITERATION_LIMIT : NOT_FINITE;
    k->best_value = -k->f;
    k->flattest = INFINITY;
    for (i = 0; i < N_ACTIONS; ++i) {
      k->g[i] = g_trial[i];
      k->best[i] = k->u[i];
    }
    k->fresh = 1;
    return finite && climb_on(k, set);
  }
  noise = SMALLEST_GAIN * fabs(k->f);
  for (i = 0; i < N_ACTIONS; ++i)
    if (k->trial[i] > 0 && k->trial[i] < 1) slope_trial += g_trial[i] * k->d[i];
  gained = finite && k->predicted < 0 &&
           (f_trial <= k->f + ARMIJO * k->predicted + noise ||
            (f_trial <= -k->best_value + HIDDEN * noise && slope_trial >= CURVATURE * k->descent &&
             slope_trial <= (2 * DECREASE - 1) * k->descent));
  ++k->tries;
  if (gained) { /* the best step so far, if not yet a good one */
    k->t_low = k->t;
    k->f_low = f_trial;
    for (i = 0; i < N_ACTIONS; ++i) {
      k->u_low[i] = k->trial[i];
      k->g_low[i] = g_trial[i];
    }
    accepted = slope_trial >= CURVATURE * k->descent || k->f - f_trial <= noise || k->tries > MOST_TRIES ||
               (isinf(k->t_high) && k->t * k->longest >= LONGEST_STEP);
    k->t = isinf(k->t_high) ? smaller(4 * k->t, LONGEST_STEP / k->longest) : (k->t_low + k->t_high) / 2;
  } else {
    double moved = 0;
    for (i = 0; i < N_ACTIONS; ++i) moved = larger(moved, fabs(k->trial[i] - k->u[i]));
    k->t_high = k->t;
    if (k->t_low > 0) {
      k->t = (k->t_low + k->t_high) / 2;
    } else { /* the minimum of the parabola through f, its slope and the new value, within a tenth
         (less where nothing is known of how long steps should be) to a half */
      double rise = f_trial - k->f - k->predicted;
      double shrink = finite && rise > 0 ? -k->predicted / (2 * rise) : 0.1;
      k->t *= smaller(larger(shrink, k->doubted ? 1e-3 : 0.1), 0.5);
    }
    if (k->tries > MOST_TRIES || moved <= 1e-16) {
      accepted = k->t_low > 0;
      if (!accepted) {
        /* No step gains any more. If the curvature pairs are to blame, the gradient alone will still gain. */
        if (k->pairs.stored == 0) k->outcome = k->doubted || k->slope <= LOOSE * k->tolerance ? CONVERGED : STALLED;
        k->fresh = 1;
        k->pairs.stored = 0;
      }
    }
  }
  if (accepted) accept(k, noise);
  remember(k, -(k->t_low > 0 && !accepted ? smaller(k->f, k->f_low) : k->f));
  /* Gains lost in rounding mean that it has arrived, if the gradient alone, without curvature pairs, gains no more. */
  if (k->doubted && k->flat >= 1) k->outcome = CONVERGED;
  if (k->flat >= 2) {
    k->doubted = 1;
    k->flat = 0;
    k->pairs.stored = 0;
  }
  return k->outcome == ITERATION_LIMIT && climb_on(k, set);
}

/* Ascend by ADADELTA (Zeiler 2012, algorithm 1, with the sign of ascent): take in value and gradient at x, and make a step;
   0 at the end. */
static int ascend(struct walk *k, const struct settings *set, double value, double *g) {
  double check = 0;
  int i, finite;
  for (i = 0; i < N_ACTIONS; ++i) check += g[i];
  finite = isfinite(value) && isfinite(check);
  if (!k->begun) {
    k->begun = 1;
    remember(k, finite ? value : -INFINITY);
    k->outcome = finite ? ITERATION_LIMIT : NOT_FINITE;
    k->value = k->best_value = finite ? value : -INFINITY;
    for (i = 0; i < N_ACTIONS; ++i) k->best[i] = k->x[i];
    if (!finite) return 0;
  } else if (!finite) {
    remember(k, -INFINITY);
    k->outcome = NOT_FINITE; /* the last finite point counts */
    for (i = 0; i < N_ACTIONS; ++i) k->x[i] = k->u[i];
    return 0;
  } else {
    const double before = k->value;
    k->value = value;
    remember(k, value);
    if (value > k->best_value) {
      k->best_value = value;
      for (i = 0; i < N_ACTIONS; ++i) k->best[i] = k->x[i];
    }
    k->falls += value < before;
    if (value >= before && value - before < k->tolerance)
      k->outcome = CONVERGED;
    else if (k->falls >= set->oscillation)
      k->outcome = OSCILLATION;
    if (k->outcome != ITERATION_LIMIT) return 0;
  }
  if (k->spent >= k->limit) return 0;
  if (*set->stop) {
    k->outcome = TIME_LIMIT;
    return 0;
  }
  for (i = 0; i < N_ACTIONS; ++i) {
    double span = set->scaled ? set->high[i] - set->low[i] : 1, slope = g[i] * span / k->scale, move;
    double *v = k->mean_square + i, *w = k->mean_move + i;
    k->u[i] = k->x[i];
    *v = set->decay * *v + (1 - set->decay) * slope * slope;
    move = slope * sqrt((*w + set->epsilon) / (*v + set->epsilon));
    *w = set->decay * *w + (1 - set->decay) * move * move;
    k->x[i] = smaller(larger(k->x[i] + move * span, set->low[i]), set->high[i]);
  }
  return 1;
}

/* Begin at x; the pairs are those of the walk itself, which must not be moved without them. */
static void begin_walk(struct walk *k, const struct settings *set, const double *x, double tolerance, double scale,
                       double *history) {
  int i;
  memset(k, 0, sizeof *k);
  k->tolerance = tolerance;
  k->scale = scale;
  k->history = history;
  k->limit = set->limit;
  k->pairs.s = k->s;
  k->pairs.y = k->y;
  k->pairs.newest = -1;
  for (i = 0; i < N_ACTIONS; ++i) {
    const double low = set->low[i], high = set->high[i];
    k->u[i] = high > low ? smaller(larger((x[i] - low) / (high - low), 0), 1) : 0;
    k->x[i] = x[i];
  }
  if (!set->ascends) place(k->u, set->low, set->high, k->x);
}

/* Leave in x and value where it has ended. */
static void end_walk(struct walk *k, const struct settings *set) {
  int i;
  if (!set->ascends) {
    place(k->best, set->low, set->high, k->x);
    k->value = k->best_value;
  } else if (set->keep_best) {
    for (i = 0; i < N_ACTIONS; ++i) k->x[i] = k->best[i];
    k->value = k->best_value;
  }
}

/* A number between bounds, which rounding to single precision must not carry it past. */
static real within(double x, double low, double high) {
  real y = (real) x;
  if ((double) y > high) y = MATH(nextafter)(y, (real) -INFINITY);
  if ((double) y < low) y = MATH(nextafter)(y, (real) INFINITY);
  return y;
}
