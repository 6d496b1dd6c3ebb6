/* How requirements are kept: the method of multipliers (Birgin & Martinez, Practical Augmented Lagrangian Methods, SIAM 2014,
   algorithm 4.1). symgraph/optimizers/constrained.py does the same. */

#define GROWTH 10.0          /* of weights */
#define MOST_GROWTH 1e9
#define ENOUGH 0.25 /* of what was missed before: while that much less is missed each time, weights stay */
#define ROUNDS 40
#define FIRST_TOLERANCE 1e-2 /* of a climb; the multipliers are not right yet */

/* The largest breach of what counts at a point where a search has ended, and 0 where moves of the actions that rounding hides
   would make up for it; -1 for NaN, or when the search had to end. Leaves J there, the breach as it is, and whose it is. */
static double judged_breach(Planner *p, const double *x, const int *choices, const double *units, double *value,
                            double *violation, int *worst) {
  double *const found = p->room.found_breaches, *const slack = p->room.slack, *const moved = p->room.moved;
  double most = 0;
  int i, k, missed = 0;
  if (!may_go_on(p)) return -1;
  evaluate(p, x, choices);
  ++p->plan->evaluations;
  *value = p->value;
  *violation = 0;
  *worst = -1;
  for (k = 0; k < N_MARGINS; ++k) {
    found[k] = counts(k, choices) ? violation_of(k, p->margins[k]) : 0;
    slack[k] = 0;
    p->room.at_end[k] = p->margins[k];
    missed |= found[k] != 0;
    *violation = larger(*violation, found[k]);
  }
  if (!missed) return 0;
  copy_actions(moved, x);
  for (i = 0; i < N_ACTIONS; ++i) {
    const double low = lower[i], high = upper[i];
    if (!may_go_on(p)) return -1;
    moved[i] += (x[i] > (low + high) / 2 ? -1 : 1) * MOVE * (high - low);
    evaluate(p, moved, choices);
    ++p->plan->evaluations;
    for (k = 0; k < N_MARGINS; ++k) {
      const double change = fabs(p->margins[k] - p->room.at_end[k]);
      if (isfinite(change)) slack[k] += change;
    }
    moved[i] = x[i];
  }
  for (k = 0; k < N_MARGINS; ++k) {
    const double unit = N_ACTIONS == 0 ? bounds_of[k] : isfinite(units[k]) ? units[k] : 0;
    if (found[k] != found[k]) return -1;
    if (found[k] > slack[k] + ROUNDING * unit && found[k] > most) {
      most = found[k];
      *worst = k;
    }
  }
  return most;
}

/* J less the augmented Lagrangian's terms at the point that was looked at last; what it pulls at is left in `pulls`. */
static double merit(Planner *p, const double *multipliers, const double *weights) {
  double value = p->value;
  int k;
  for (k = 0; k < N_MARGINS; ++k) {
    double pulled = 0;
    if (weights[k] > 0) {
      pulled = multipliers[k] + weights[k] * p->margins[k];
      if (!equalities[k] && pulled < 0) pulled = 0;
      value -= (pulled * pulled - multipliers[k] * multipliers[k]) / (2 * weights[k]);
    }
    p->pulls[k] = (real) -pulled;
  }
  return value;
}

/* Walk from x where the walk's settings lead, on J less penalties. Returns 0 if it had to end. */
static int walk_on_merit(Planner *p, const double *x, const int *choices, double tolerance, double scale) {
  const struct room *room = &p->room;
  struct walk *const walk = &p->walk;
  int goes_on = 1;
  begin_walk(walk, &p->settings, x, tolerance, scale, 0);
  while (goes_on && may_go_on(p)) {
    double value;
    look(p, walk->x, choices);
    value = merit(p, room->multipliers, room->weights);
    differentiate(p);
    goes_on = (p->settings.ascends ? ascend : climb)(walk, &p->settings, value, p->gradient);
  }
  end_walk(walk, &p->settings);
  return !goes_on;
}

static void first_weights(Planner *p, double scale, const double *units) {
  int k;
  for (k = 0; k < N_MARGINS; ++k) {
    p->room.multipliers[k] = 0;
    p->room.weights[k] = isinf(units[k]) ? 0 : FIRST_WEIGHT * scale / units[k] / units[k];
  }
}

/* Climb from x, and leave in the walk where it ended: at a local maximum that meets all requirements, or where least is missed;
   but a point on the way that meets all is not given up. Returns 0 if it had to end. */
static int climb_within(Planner *p, const double *x, const int *choices, double tolerance, double scale, const double *units,
                        long iterations, long *gradients) {
  struct room *const room = &p->room;
  double before = INFINITY, slack = FIRST_TOLERANCE, growth = 1, kept_value = 0;
  int rounds = 0, keeps = 0, k;
  first_weights(p, scale, units);
  copy_actions(room->point, x);
  if (!may_go_on(p)) return 0;
  if (look(p, x, choices) && share_of(p->margins, units) <= CLOSE) {
    keeps = 1;
    kept_value = p->value;
    copy_actions(room->kept_point, x);
  }
  *gradients = 0;
  for (;;) {
    double wrong = 0, share;
    int settled, over;
    p->settings.limit = iterations - *gradients;
    if (!walk_on_merit(p, room->point, choices, larger(tolerance, slack) * scale, 1)) return 0;
    ++rounds;
    *gradients += (long) p->walk.spent;
    if (p->walk.outcome == NOT_FINITE) {
      copy_actions(p->walk.x, keeps ? room->kept_point : room->point);
      return 1;
    }
    copy_actions(room->point, p->walk.x);
    if (!may_go_on(p)) return 0;
    look(p, room->point, choices);
    share = share_of(p->margins, units);
    for (k = 0; k < N_MARGINS; ++k)
      if (room->weights[k] > 0) {
        double pulled = room->multipliers[k] + room->weights[k] * p->margins[k], error;
        if (!equalities[k] && pulled < 0) pulled = 0;
        error = fabs((pulled - room->multipliers[k]) / room->weights[k] / units[k]);
        if (!(error <= wrong)) wrong = error;
        room->pulled[k] = pulled;
      } else {
        room->pulled[k] = 0;
      }
    if (share <= CLOSE && (!keeps || p->value >= kept_value)) {
      keeps = 1;
      kept_value = p->value;
      copy_actions(room->kept_point, room->point);
    }
    settled = slack <= tolerance && wrong <= CLOSE;
    over = *gradients >= iterations || rounds >= ROUNDS || growth > MOST_GROWTH;
    if (settled || over) {
      if (!settled && keeps) copy_actions(p->walk.x, room->kept_point);
      return 1;
    }
    for (k = 0; k < N_MARGINS; ++k) room->multipliers[k] = room->pulled[k];
    if (wrong > ENOUGH * before && wrong > CLOSE) {
      for (k = 0; k < N_MARGINS; ++k) room->weights[k] *= GROWTH;
      growth *= GROWTH;
    }
    before = wrong;
    slack /= 10;
  }
}
