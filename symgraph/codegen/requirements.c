/* How requirements are judged: units and penalties. symgraph/optimizers/constrained.py does the same. */

#ifdef SINGLE
#define MOVE 1e-5     /* [range] what such moves would make up for counts as rounding */
#define ROUNDING 1e-6 /* [unit of a constraint] likewise: where margins are flat, moves make up for nothing */
#define CLOSE 1e-6    /* [unit of a constraint] what a search goes on to */
#else
#define MOVE 1e-6
#define ROUNDING 1e-9
#define CLOSE 1e-10
#endif
#define SMALLEST_UNIT 1e-100 /* its square must still be a number */
#define FIRST_WEIGHT 1000.0  /* less lets a climb leave for where nothing leads back to what is required */

/* Whether a constraint counts under these choices. */
static int counts(int k, const int *choices) {
  int i;
  for (i = way_begins[k]; i < way_begins[k + 1]; ++i)
    if (choices[ways[i][0]] != ways[i][1]) return 0;
  return 1;
}

static double violation_of(int k, double margin) {
  if (equalities[k]) return fabs(margin);
  return margin > 0 || margin != margin ? margin : 0;
}

/* Take the units under some choices from margins (SCALE_SAMPLES, N_MARGINS), which are lost. */
static void learn_units(const int *choices, double *margins, double *column, double *units) {
  int k, r;
  for (k = 0; k < N_MARGINS; ++k) {
    double low = INFINITY, high = -INFINITY, range, quarter, unit;
    for (r = 0; r < SCALE_SAMPLES; ++r) {
      const double margin = margins[r * N_MARGINS + k];
      int i = r;
      const double size = isfinite(margin) ? fabs(margin) : INFINITY;
      if (isfinite(margin)) {
        low = smaller(low, margin);
        high = larger(high, margin);
      }
      for (; i > 0 && column[i - 1] > size; --i) column[i] = column[i - 1];
      column[i] = size;
    }
    quarter = column[SCALE_SAMPLES / 4];
    range = high - low;
    unit = quarter > 0 && quarter < range ? quarter : range;
    if (!(unit > SMALLEST_UNIT) || !isfinite(unit)) unit = larger(bounds_of[k], 1);
    units[k] = counts(k, choices) ? unit : INFINITY;
  }
}

/* The largest breach in units of the constraints; NaN where a margin is. */
static double share_of(const double *margins, const double *units) {
  double most = 0;
  int k;
  for (k = 0; k < N_MARGINS; ++k) {
    const double share = isinf(units[k]) ? 0 : violation_of(k, margins[k]) / units[k];
    if (!(share <= most)) most = share;
    if (most != most) break;
  }
  return most;
}

/* Penalties, w/2 · breach² with w = FIRST_WEIGHT · scale / unit². */
static double penalty_of(const double *margins, const double *units, double scale) {
  double sum = 0;
  int k;
  for (k = 0; k < N_MARGINS; ++k)
    if (!isinf(units[k])) {
      const double breach = violation_of(k, margins[k]);
      sum += FIRST_WEIGHT * scale / units[k] / units[k] / 2 * breach * breach;
    }
  return sum;
}

/* The largest breach of what counts at the point that was looked at last, 0 where it is far below a unit; -1 for NaN. */
static double breach(const Planner *p, const int *choices, double *violation, int *worst) {
  double most = 0;
  int k;
  *violation = 0;
  *worst = -1;
  for (k = 0; k < N_MARGINS; ++k)
    if (counts(k, choices)) {
      const double found = violation_of(k, p->margins[k]);
      if (found != found) return -1;
      *violation = larger(*violation, found);
      if (found > ROUNDING * larger(bounds_of[k], 1) && found > most) {
        most = found;
        *worst = k;
      }
    }
  return most;
}
