/* Where searches start: samples spread over bounds and choices, and what the caller suggests. symgraph/optimizers/starts.py and
   problem.py do the same. */

#define FEWEST_SAMPLES 16
#define MOST_SAMPLES_OF_ROUND 32 /* of one combination of choices, under a budget */
#define MOST_GROUPS_OF_ROUND 64
#define MOST_EVEN 1000000000.0 /* combinations, beyond which each selection is drawn on its own */

static long more(long a, long b) { return a > b ? a : b; }
static long fewer(long a, long b) { return a < b ? a : b; }

/* The size of the differences of J that matter, from values of samples, which are sorted; 0 if too few are finite. */
static double scale_from(double *values, int count, int fewest) {
  int n = 0, i, j, gap = 1;
  double spread;
  for (i = 0; i < count; ++i)
    if (isfinite(values[i])) values[n++] = values[i];
  while (gap < n / 3) gap = 3 * gap + 1;
  for (; gap > 0; gap /= 3)
    for (i = gap; i < n; ++i) {
      const double value = values[i];
      for (j = i; j >= gap && values[j - gap] > value; j -= gap) values[j] = values[j - gap];
      values[j] = value;
    }
  if (n < fewest) return 0;
  spread = values[n - 1 - n / 4] - values[n / 4]; /* the middle half, or the whole range where there is a peak on a plain */
  if (spread == 0) spread = values[n - 1] - values[0];
  return spread == 0 ? 1 : spread;
}

/* What is kept of a combination of choices; the oldest entry makes room for a new one. */
static struct known *entry(Planner *p, const int *choices) {
  struct room *const room = &p->room;
  struct known *here;
  int i;
  for (i = 0; i < KNOWN; ++i)
    if (room->known[i].filled && same_choices(room->known[i].choices, choices)) return room->known + i;
  here = room->known + room->next_known;
  room->next_known = (room->next_known + 1) % KNOWN;
  here->filled = 1;
  here->scale = 0;
  copy_choices(here->choices, choices);
  return here;
}

/* What is known of a combination of choices, found out where it is not, at points that are always the same ones. */
static struct known *knowledge_of(Planner *p, const int *choices) {
  struct room *const room = &p->room;
  struct known *const here = entry(p, choices);
  int count = SCALE_SAMPLES, i, k;
  if (here->scale > 0) return here;
  if (!room->has_typical) { /* drawn when they are needed: that takes time */
    struct draws fixed;
    seed_draws(&fixed, 0);
    spread_points(p, &fixed, SCALE_SAMPLES, p->low, p->high, room->typical, room->typical_scratch, room->column,
                  room->typical_order);
    room->has_typical = 1;
  }
#if !REQUIREMENTS
  if (is_limited(p)) count /= 4; /* a rough scale will do */
#endif
  for (i = 0; i < count; ++i) {
    const int looked = may_go_on(p) && look(p, room->typical + i * N_ACTIONS, choices);
    room->column[i] = looked ? p->value : -INFINITY;
    for (k = 0; k < N_MARGINS; ++k) room->margins[i * N_MARGINS + k] = looked ? p->margins[k] : NAN;
  }
  here->scale = scale_from(room->column, count, count / 2);
  if (here->scale == 0) here->scale = 1;
#if REQUIREMENTS
  learn_units(choices, room->margins, room->column, here->units);
#endif
  return here;
}

/* Rows of choices: all combinations as often as they fit, and some of them at random; or each selection at random. */
static void draw_rows(Planner *p, int count, int evenly) {
  struct room *const room = &p->room;
  const long all = combinations(p);
  int r, s;
  if (!evenly || (double) all > MOST_EVEN) {
    for (r = 0; r < count; ++r)
      for (s = 0; s < N_SELECTIONS; ++s) {
        const double unit = uniform(&p->draws);
        room->rows[r * N_SELECTIONS + s] = p->held[s] < 0 ? (int) (unit * sizes[s]) : p->held[s];
      }
    return;
  }
  r = (int) (count / all * all);
  distinct(&p->draws, (int) all, count - r, room->numbers + r);
  for (s = 0; s < r; ++s) room->numbers[s] = (int) (s % all);
  for (r = 0; r < count; ++r) decode(p, room->numbers[r], room->rows + r * N_SELECTIONS);
}

/* What a search from a point may come to: J there less penalties; -INFINITY where it is not finite. */
static double merit_at(Planner *p, const double *x, const int *choices, int *fits) {
#if REQUIREMENTS
  const struct known *here = knowledge_of(p, choices);
  double value;
  *fits = 0;
  if (!may_go_on(p) || !look(p, x, choices)) return -INFINITY;
  *fits = share_of(p->margins, here->units) <= 0;
  value = p->value - penalty_of(p->margins, here->units, here->scale);
  return isfinite(value) ? value : -INFINITY;
#else
  *fits = 1;
  return may_go_on(p) && look(p, x, choices) ? p->value : -INFINITY;
#endif
}

/* Of samples sorted by merit, the best one and those of the better half that lie farthest from any better one. Leaves `count`
   of them at the beginning of `order`. */
static void find_peaks(Planner *p, int samples, int count) {
  struct room *const room = &p->room;
  const int half = (int) more(count, (samples + 1) / 2);
  int a, b, i;
  sort_indices(room->order, samples, room->merits, 0);
  if (half <= count) return;
  for (a = 0; a < half; ++a) {
    double nearest = INFINITY;
    if (is_late(p)) return; /* the best ones */
    for (b = 0; b < a; ++b) {
      const double *x = room->points + room->order[a] * N_ACTIONS, *y = room->points + room->order[b] * N_ACTIONS;
      double square = 0;
      for (i = 0; i < N_ACTIONS; ++i)
        if (p->high[i] > p->low[i]) {
          const double apart = (x[i] - y[i]) / (p->high[i] - p->low[i]);
          square += apart * apart;
        }
      nearest = smaller(nearest, square);
    }
    room->keys[a] = nearest;
    room->ranks[a] = a;
  }
  sort_indices(room->ranks, half, room->keys, 0);
  for (a = 0; a < count; ++a) room->picked[a] = room->order[room->ranks[a]];
  for (a = 0; a < count; ++a) room->order[a] = room->picked[a];
}

/* Whether a start is tried before another one, where not all combinations have one. */
static int comes_before(const struct start *a, const struct start *b) {
  return a->fits != b->fits ? a->fits : a->merit > b->merit;
}

/* Sample the bounds under one combination of choices, and keep the most promising points: `each` of them in turn with those of
   other combinations, or those that are among the best of all. */
static void sample(Planner *p, const int *choices, int count, int each, int group, int groups, int starts) {
  const double share = SAMPLING * (group + 1) / groups; /* none must use up what is meant for others */
  struct room *const room = &p->room;
#if REQUIREMENTS
  struct known *const here = knowledge_of(p, choices);
#endif
  int looked = 0, r, i, e;
  double scale;
  spread_points(p, &p->draws, count, p->low, p->high, room->points, room->scratch, room->keys, room->order);
  for (; looked < count && may_go_on(p); ++looked) {
    if (looked > 0 && has_spent(p, share)) {
      p->cut_short = 1;
      break;
    }
    room->order[looked] = looked;
    room->values[looked] = look(p, room->points + looked * N_ACTIONS, choices) ? p->value : -INFINITY;
    room->merits[looked] = room->values[looked];
#if REQUIREMENTS
    room->penalties[looked] = penalty_of(p->margins, here->units, 1);
    room->fitting[looked] = share_of(p->margins, here->units) <= 0;
#else
    room->fitting[looked] = 1;
#endif
  }
  if (looked == 0) return;
  scale = scale_from(room->values, looked, is_limited(p) ? FEWEST_SAMPLES / 4 : FEWEST_SAMPLES);
  if (scale > 0) entry(p, choices)->scale = scale;
#if REQUIREMENTS
  for (r = 0; r < looked; ++r) {
    const double value = room->merits[r] - here->scale * room->penalties[r];
    room->merits[r] = isfinite(value) ? value : -INFINITY;
  }
#endif
  each = (int) fewer(each, looked);
  find_peaks(p, looked, each);
  for (e = 0; e < each; ++e) {
    struct start made;
    r = room->order[e];
    for (i = 0; i < N_ACTIONS; ++i) made.x[i] = room->points[r * N_ACTIONS + i];
    copy_choices(made.choices, choices);
    made.merit = room->merits[r];
    made.fits = room->fitting[r];
    made.used = 1;
    if (groups <= starts) {
      room->starts[MOST_GUESSES + e * groups + group] = made;
    } else { /* the list of the best so far, in order */
      int at = starts;
      struct start *const kept = room->starts + MOST_GUESSES;
      while (at > 0 && (!kept[at - 1].used || comes_before(&made, kept + at - 1))) {
        if (at < starts) kept[at] = kept[at - 1];
        --at;
      }
      if (at < starts) kept[at] = made;
    }
  }
}

/* Leave start points behind those that are suggested: the most promising of samples spread over the bounds. Under a budget
   of few samples, so that the next look at the clock is never far. */
static void find_promising(Planner *p, int starts, int samples) {
  const long all = combinations(p);
  const int limited = is_limited(p);
  const int groups = (int) fewer(all, more(starts, limited ? MOST_GROUPS_OF_ROUND : MOST_SAMPLES_OF_ONE));
  const int wanted = (int) more(1, starts / groups), most = limited ? MOST_SAMPLES_OF_ROUND : MOST_SAMPLES_OF_ONE;
  const int each = limited ? (int) fewer(wanted, more(1, most / samples)) : wanted;
  const int count = N_ACTIONS ? (int) more(each, fewer((long) each * samples, most)) : 1;
  struct room *const room = &p->room;
  int g;
  p->cut_short = 0;
  draw_rows(p, groups, 1);
  for (g = 0; g < groups && may_go_on(p); ++g) {
    if (groups > starts && g > 0 && has_spent(p, SAMPLING)) {
      p->cut_short = 1;
      break;
    }
    sample(p, room->rows + g * N_SELECTIONS, count, each, g, groups, starts);
  }
}

/* Put the caller's start points first. Actions that they leave out are drawn, selections are those that promise most there. */
static void add_guesses(Planner *p) {
  struct room *const room = &p->room;
  const planner_options *o = p->options;
  const int count = o->start_count;
  int g, i, s, r, count_of_rows;
  for (g = 0; g < count; ++g) {
    struct start *here = room->starts + g;
    memcpy(here->x, &o->starts[g].actions, N_ACTIONS * sizeof(double));
    memcpy(here->choices, &o->starts[g].selections, N_SELECTIONS * sizeof(int));
    for (i = 0; i < N_ACTIONS; ++i) {
      const double drawn = p->low[i] + (p->high[i] - p->low[i]) * uniform(&p->draws);
      here->x[i] = smaller(larger(here->x[i] != here->x[i] ? drawn : here->x[i], p->low[i]), p->high[i]);
    }
  }
  for (g = 0; g < count; ++g) {
    struct start *here = room->starts + g, best;
    int open = 0;
    here->used = 1;
    for (s = 0; s < N_SELECTIONS; ++s) {
      if (p->held[s] >= 0) here->choices[s] = p->held[s];
      open |= here->choices[s] < 0;
    }
    if (!open && is_limited(p) && may_go_on(p)) look(p, here->x, here->choices); /* no plan may be worse */
    count_of_rows = (int) fewer(combinations(p), MOST_SAMPLES_OF_ONE);
    draw_rows(p, count_of_rows, 1); /* for the same draws as in Python also where none is needed */
    if (!open) continue;
    best = *here;
    best.used = 0;
    for (r = 0; r < count_of_rows && (r == 0 || may_go_on(p)); ++r) {
      struct start one = *here;
      for (s = 0; s < N_SELECTIONS; ++s)
        if (one.choices[s] < 0) one.choices[s] = room->rows[r * N_SELECTIONS + s];
      if (best.used && same_choices(one.choices, best.choices)) continue;
      one.merit = merit_at(p, one.x, one.choices, &one.fits);
      if (!best.used || comes_before(&one, &best)) best = one;
    }
    *here = best;
    here->used = 1;
  }
}
