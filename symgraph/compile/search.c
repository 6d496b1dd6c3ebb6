/* Local search from many points side by side.

   Standard C but for atomic operations, libm only, no allocation, no globals. Before this file stand team.c and walks.c; the
   file that includes this one defines
     N_SELECTIONS               numbers of choices
     MOST_LANES                 points that are evaluated side by side
     fill, evaluate             how many lanes are worked on for so many points; values and gradients of B lanes
   Each point has a walk; when one has ended, the next point takes its place. */

/* Numbers of B lanes side by side: x (N_ACTIONS, B), chosen (N_SELECTIONS, B), value (B), gradient (N_ACTIONS, B). */
struct lanes {
  real *x, *chosen, *value, *gradient;
  const void *given; /* what evaluate needs besides */
};
static int fill(long count);
static void evaluate(const struct lanes *lanes, long B, struct member *me);

/* Searches from many points. Points that are evaluated side by side have the same selections. */
struct search {
  struct settings set;
  long count, active; /* points, and walks under way here */
  long *next;         /* the first point that waits, for all searches */
  long most;          /* walks at once: searches share few points evenly */
  const double *points, *chosen, *tolerances, *scales; /* (count, N_ACTIONS), (count, N_SELECTIONS), (count), (count) */
  double *ends, *values, *histories;                   /* (count, N_ACTIONS), (count), (count, limit) */
  int *outcomes;                                       /* (count), UNDER_WAY at first */
  long long *spent;                                    /* (count) */
  struct walk walks[MOST_LANES];
};

static void begin(struct search *all, long start) {
  struct walk *k = all->walks + all->active++;
  begin_walk(k, &all->set, all->points + start * N_ACTIONS, all->tolerances[start], all->scales[start],
             all->histories + start * all->set.limit);
  k->start = start;
}

static void end(struct search *all, struct walk *k) {
  double *point = all->ends + k->start * N_ACTIONS;
  int i;
  end_walk(k, &all->set);
  for (i = 0; i < N_ACTIONS; ++i) point[i] = k->x[i];
  all->values[k->start] = k->value;
  all->spent[k->start] = k->spent;
  all->outcomes[k->start] = k->outcome;
}

/* Let points that wait take places; then say where all walks are to be evaluated. Returns for how many lanes. */
static long prepare(struct search *all, const struct lanes *lanes) {
  long b, B;
  int i;
  for (;;) { /* a point takes a place if it has the same selections as the others */
    long start = __atomic_load_n(all->next, __ATOMIC_RELAXED);
    if (all->active >= all->most || start >= all->count) break;
    if (start > 0 && *all->set.stop) break; /* time is over: the first one alone is looked at whatever happens */
    if (all->active && memcmp(all->chosen + start * N_SELECTIONS, all->chosen + all->walks[0].start * N_SELECTIONS,
                              N_SELECTIONS * sizeof(double)))
      break;
    if (__atomic_compare_exchange_n(all->next, &start, start + 1, 0, __ATOMIC_RELAXED, __ATOMIC_RELAXED))
      begin(all, start);
  }
  if (!all->active) return 0;
  B = fill(all->active);
  for (b = 0; b < B; ++b) {
    const struct walk *k = all->walks + (b < all->active ? b : 0);
    for (i = 0; i < N_ACTIONS; ++i) lanes->x[i * B + b] = within(k->x[i], all->set.low[i], all->set.high[i]);
    for (i = 0; i < N_SELECTIONS; ++i) lanes->chosen[i * B + b] = (real) all->chosen[k->start * N_SELECTIONS + i];
  }
  return B;
}

/* Let each walk make a step, after it was evaluated; those that have ended leave their places. */
static void step_all(struct search *all, const struct lanes *lanes, long B) {
  long b, left = 0;
  int i;
  for (b = 0; b < all->active; ++b) {
    struct walk *k = all->walks + b;
    double *const gradient = k->scratch[2];
    for (i = 0; i < N_ACTIONS; ++i) gradient[i] = (double) lanes->gradient[i * B + b];
    if ((all->set.ascends ? ascend : climb)(k, &all->set, (double) lanes->value[b], gradient)) {
      if (left < b) {
        all->walks[left] = *k;
        all->walks[left].pairs.s = all->walks[left].s;
        all->walks[left].pairs.y = all->walks[left].y;
      }
      ++left;
    } else {
      end(all, k);
    }
  }
  all->active = left;
}

/* Evaluate all walks once and let each make a step, `rounds` times or until none is left. */
static void advance(struct member *me, struct search *all, const struct lanes *lanes, long rounds) {
  struct team *const team = me->team;
  for (; rounds > 0; --rounds) {
    if (me->index == 0) team->lanes = prepare(all, lanes);
    meet(me);
    if (!team->lanes) return;
    evaluate(lanes, team->lanes, me);
    if (me->index == 0) step_all(all, lanes, team->lanes);
  }
}
