/* Local search from one point, next to the gradient: projected L-BFGS and ADADELTA.

   C99, libm only, no allocation, no globals. The file that includes this one defines
     N_ACTIONS                  number of stacked actions
     struct inputs              what evaluate() needs besides the actions, and `stop`: not 0 once time is over
     int evaluate(const double *x, const struct inputs *in, double *value, double *gradient)
                                returns 0, or 1 where the model failed
   interpreted.py does the same, step for step, where there is no compiler: change both.
   Bounds are low[N_ACTIONS], high[N_ACTIONS]; an action with low == high is held. */

enum outcome { CONVERGED, ITERATION_LIMIT, OSCILLATION, STALLED, NOT_FINITE, TIME_LIMIT };

#define PAIRS (N_ACTIONS < 8 ? (N_ACTIONS > 0 ? N_ACTIONS : 1) : 8) /* curvature pairs that L-BFGS keeps */
#define SEARCH_WORK (2 * PAIRS * N_ACTIONS + 11 * N_ACTIONS + 1)          /* doubles of workspace */

static const double FIRST_STEP = 0.05;     /* [range] no curvature is known yet */
static const double LONGEST_STEP = 0.5;    /* [range] no step crosses more than half of it */
static const double ARMIJO = 1e-4;         /* sufficient decrease: Nocedal & Wright 2006, equation 3.4 */
static const double CURVATURE = 0.9;       /* how much flatter a step must end: equation 3.6b there */
static const double LOOSE = 1e3;           /* times the tolerance: converged where rounding hides all further gain */
static const int MOST_ROUNDS = 10;         /* of sending actions to their bounds */
static const int MOST_TRIES = 50;          /* steps of one line search */
static const double SMALLEST_GAIN = 1e-15; /* relative to the value: less cannot be told from rounding */

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

static double largest(const double *a) {
  double found = 0;
  int i;
  for (i = 0; i < N_ACTIONS; ++i) found = fmax(found, fabs(a[i]));
  return found;
}

/* x = low + (high - low) u, which rounding must not carry past a bound. */
static void place(const double *u, const double *low, const double *high, double *x) {
  int i;
  for (i = 0; i < N_ACTIONS; ++i) x[i] = fmin(fmax(low[i] + (high[i] - low[i]) * u[i], low[i]), high[i]);
}

/* f = -J and its gradient over u = (x - low) / (high - low); returns whether all is finite. */
static int descend_value(const double *u, const struct inputs *in, const double *low, const double *high, double *x,
                         double *f, double *g) {
  double value = 0, check = 0;
  int i;
  place(u, low, high, x);
  if (evaluate(x, in, &value, g)) return 0;
  for (i = 0; i < N_ACTIONS; ++i) {
    g[i] *= -(high[i] - low[i]);
    check += g[i];
  }
  *f = -value;
  return isfinite(value) && isfinite(check);
}

/* d = -H g within the actions of the mask, by the two-loop recursion over the curvature pairs, newest first (Nocedal &
   Wright 2006, algorithm 7.4). */
static void quasi_newton(const struct pairs *pairs, const double *g, const double *mask, double *d) {
  double alpha[PAIRS], rho[PAIRS], scale = 1;
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

/* Climb from x to a local maximum within the bounds by projected L-BFGS (Liu & Nocedal 1989). The line search brackets a
   step that satisfies the weak Wolfe conditions, with which BFGS also gets past kinks (Lewis & Overton 2013).
   history takes up to `iterations` values, one for each gradient; returns their number. */
static long long climb(double *x, const struct inputs *in, const double *low, const double *high, long long iterations,
                       double tolerance, double *value, int *outcome, double *history, double *work) {
  struct pairs pairs = {work, work + PAIRS * N_ACTIONS, 0, -1};
  double *u = work + 2 * PAIRS * N_ACTIONS, *g = u + N_ACTIONS, *d = g + N_ACTIONS, *trial = d + N_ACTIONS, *g_trial = trial + N_ACTIONS;
  double *u_low = g_trial + N_ACTIONS, *g_low = u_low + N_ACTIONS, *mask = g_low + N_ACTIONS, *step = mask + N_ACTIONS;
  double *change = step + N_ACTIONS, *free = change + N_ACTIONS;
  double f = 0, f_low = 0, f_trial = 0, descent = 0, longest = 0, slope = 0;
  double t = 1, t_low = 0, t_high = INFINITY; /* steps between which the line search looks */
  long long spent = 1;
  int i, fresh = 1, flat = 0, tries = 0, doubted = 0;

  for (i = 0; i < N_ACTIONS; ++i) u[i] = high[i] > low[i] ? fmin(fmax((x[i] - low[i]) / (high[i] - low[i]), 0), 1) : 0;
  if (!descend_value(u, in, low, high, x, &f, g)) {
    *value = history[0] = -INFINITY;
    *outcome = NOT_FINITE;
    return 1;
  }
  history[0] = -f;
  *outcome = ITERATION_LIMIT;
  for (;;) {
    double predicted = 0, slope_trial = 0, noise = SMALLEST_GAIN * fabs(f);
    int finite, gained, accepted = 0;
    if (*in->stop) {
      iterations = spent;
      *outcome = TIME_LIMIT;
    }
    if (fresh) {
      slope = 0;
      for (i = 0; i < N_ACTIONS; ++i) {
        int held = high[i] <= low[i] || (u[i] <= 0 && g[i] > 0) || (u[i] >= 1 && g[i] < 0);
        mask[i] = held ? 0 : 1;
        slope = fmax(slope, mask[i] * fabs(g[i]));
      }
      if (slope <= tolerance) {
        *outcome = CONVERGED;
        break;
      }
      for (i = 0; i < N_ACTIONS; ++i) free[i] = mask[i];
      descent = direction(&pairs, u, g, mask, d, change);
      if (pairs.stored == 0 || !(descent < 0)) { /* nothing known of the curvature: along the gradient */
        descent = 0;
        for (i = 0; i < N_ACTIONS; ++i) {
          d[i] = -free[i] * g[i] * (FIRST_STEP / slope);
          descent += g[i] * d[i];
        }
      }
      longest = largest(d);
      t = longest > LONGEST_STEP ? LONGEST_STEP / longest : 1;
      t_low = 0;
      t_high = INFINITY;
      tries = 0;
      fresh = 0;
    }
    if (spent >= iterations) {
      accepted = t_low > 0;
    } else {
      for (i = 0; i < N_ACTIONS; ++i) {
        trial[i] = fmin(fmax(u[i] + t * d[i], 0), 1);
        step[i] = trial[i] - u[i];
        predicted += g[i] * step[i];
      }
      finite = descend_value(trial, in, low, high, x, &f_trial, g_trial);
      gained = finite && predicted < 0 && f_trial <= f + ARMIJO * predicted + noise;
      for (i = 0; i < N_ACTIONS; ++i)
        if (trial[i] > 0 && trial[i] < 1) slope_trial += g_trial[i] * d[i];
      ++tries;
      if (gained) { /* the best step so far, if not yet a good one */
        t_low = t;
        f_low = f_trial;
        for (i = 0; i < N_ACTIONS; ++i) {
          u_low[i] = trial[i];
          g_low[i] = g_trial[i];
        }
        accepted = slope_trial >= CURVATURE * descent || f - f_trial <= noise || tries > MOST_TRIES ||
                   (isinf(t_high) && t * longest >= LONGEST_STEP);
        t = isinf(t_high) ? fmin(4 * t, LONGEST_STEP / longest) : (t_low + t_high) / 2;
      } else {
        t_high = t;
        if (t_low > 0) {
          t = (t_low + t_high) / 2;
        } else { /* the minimum of the parabola through f, its slope and the new value, within a tenth to a half */
          double rise = f_trial - f - predicted;
          double shrink = finite && rise > 0 ? -predicted / (2 * rise) : 0.1;
          t *= fmin(fmax(shrink, 0.1), 0.5);
        }
        if (tries > MOST_TRIES || largest(step) <= 1e-16) {
          accepted = t_low > 0;
          if (!accepted) {
            /* No step gains any more. If the curvature pairs are to blame, the gradient alone will still gain. */
            if (pairs.stored == 0) *outcome = doubted || slope <= LOOSE * tolerance ? CONVERGED : STALLED;
            fresh = 1;
          }
        }
      }
    }
    if (accepted) {
      double sy = 0, ss = 0, yy = 0;
      for (i = 0; i < N_ACTIONS; ++i) {
        step[i] = u_low[i] - u[i];
        change[i] = g_low[i] - g[i];
        sy += step[i] * change[i];
        ss += step[i] * step[i];
        yy += change[i] * change[i];
      }
      if (sy > 1e-12 * sqrt(ss * yy)) {
        pairs.newest = (pairs.newest + 1) % PAIRS;
        if (pairs.stored < PAIRS) ++pairs.stored;
        for (i = 0; i < N_ACTIONS; ++i) {
          pairs.s[nth(&pairs, 0) + i] = step[i];
          pairs.y[nth(&pairs, 0) + i] = change[i];
        }
      }
      if (f - f_low > noise) flat = doubted = 0;
      else if (tries == 1 || doubted) ++flat;
      f = f_low;
      for (i = 0; i < N_ACTIONS; ++i) {
        u[i] = u_low[i];
        g[i] = g_low[i];
      }
      fresh = 1;
    } else if (fresh) {
      pairs.stored = 0;
    }
    if (spent >= iterations) break;
    history[spent++] = -(t_low > 0 && !accepted ? fmin(f, f_low) : f);
    /* Gains lost in rounding mean that it has arrived, if the gradient alone, without curvature pairs, gains no more. */
    if (doubted && flat >= 1) *outcome = CONVERGED;
    if (flat >= 2) {
      doubted = 1;
      flat = 0;
      pairs.stored = 0;
    }
    if (*outcome != ITERATION_LIMIT) break;
  }
  place(u, low, high, x);
  *value = -f;
  return spent;
}

/* Move x by ADADELTA (Zeiler, arXiv:1212.5701, algorithm 1, with the sign of ascent) for at most `limit` steps.
   J is divided by `scale`. history takes up to limit + 1 values, the start's first; returns their number. */
static long long ascend(double *x, const struct inputs *in, const double *low, const double *high, long long limit,
                        double rho, double epsilon, double tolerance, double scale, int oscillation, int scaled,
                        int keep_best, double *value, int *outcome, double *history, double *work) {
  double *g = work, *v = g + N_ACTIONS, *w = v + N_ACTIONS, *best = w + N_ACTIONS, *last = best + N_ACTIONS;
  double j = 0, before, best_value, check = 0;
  long long step = 0;
  int i, falls = 0, failed = evaluate(x, in, &j, g);
  for (i = 0; i < N_ACTIONS; ++i) {
    v[i] = w[i] = 0;
    best[i] = x[i];
    check += g[i];
  }
  history[0] = j;
  *outcome = ITERATION_LIMIT;
  if (failed || !isfinite(j) || !isfinite(check)) {
    *value = history[0] = -INFINITY;
    *outcome = NOT_FINITE;
    return 1;
  }
  best_value = j;
  while (step < limit) {
    if (*in->stop) {
      *outcome = TIME_LIMIT;
      break;
    }
    before = j;
    for (i = 0; i < N_ACTIONS; ++i) {
      double span = scaled ? high[i] - low[i] : 1, slope = g[i] * span / scale, delta;
      last[i] = x[i];
      v[i] = rho * v[i] + (1 - rho) * slope * slope;
      delta = slope * sqrt((w[i] + epsilon) / (v[i] + epsilon));
      w[i] = rho * w[i] + (1 - rho) * delta * delta;
      x[i] = fmin(fmax(x[i] + delta * span, low[i]), high[i]);
    }
    failed = evaluate(x, in, &j, g);
    check = 0;
    for (i = 0; i < N_ACTIONS; ++i) check += g[i];
    if (failed || !isfinite(j) || !isfinite(check)) {
      history[++step] = -INFINITY;
      j = before; /* the last finite iterate counts */
      for (i = 0; i < N_ACTIONS; ++i) x[i] = last[i];
      *outcome = NOT_FINITE;
      break;
    }
    history[++step] = j;
    if (j > best_value) {
      best_value = j;
      for (i = 0; i < N_ACTIONS; ++i) best[i] = x[i];
    }
    if (j >= before && j - before < tolerance) {
      *outcome = CONVERGED;
      break;
    }
    falls += j < before;
    if (falls >= oscillation) {
      *outcome = OSCILLATION;
      break;
    }
  }
  *value = j;
  if (keep_best) {
    for (i = 0; i < N_ACTIONS; ++i) x[i] = best[i];
    *value = best_value;
  }
  return step + 1;
}
