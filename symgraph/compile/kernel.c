/* What Python calls, each member of a team on its own, with a team of one where threads share no evaluations. Before this
   file stand the numbers of the task, the function `early` of what is bound and the function `late` of actions, selections
   and the same, and search.c. */

/* Bound inputs, the block that EARLY made of them, and workspace. */
struct given {
  const real *const *shared; /* N_SHARED of them, then the block */
  real *work;
};

static int fill(long count) { return (int) (MOST_LANES == 1 ? 1 : (count + VL - 1) / VL * VL); }

static void evaluate(const struct lanes *lanes, long B, struct member *me) {
  const struct given *given = (const struct given *) lanes->given;
  const real *arg[N_SHARED + 3];
  real *res[2];
  int i;
  arg[0] = lanes->x;
  arg[1] = lanes->chosen;
  for (i = 0; i <= N_SHARED; ++i) arg[2 + i] = given->shared[i];
  res[0] = lanes->value;
  res[1] = lanes->gradient;
#if defined(SINGLE) && defined(__SSE2__)
  {
    /* The tails of densities fall below the normal numbers of single precision, which processors are slow at: for the time
       of this call they are zero. */
    const unsigned mode = _mm_getcsr();
    _mm_setcsr(mode | 0x8040);
    late(arg, res, given->work, B, me);
    _mm_setcsr(mode);
  }
#else
  late(arg, res, given->work, B, me);
#endif
}

/* Numbers that Python has to provide: in the block, of workspace for binding, of workspace for evaluation; bytes of a search.
   Then, whether members of a team share evaluations. */
void symgraph_sizes(long long *sizes) {
  sizes[0] = BLOCK;
  sizes[1] = EARLY_WORK;
  sizes[2] = (2LL * N_ACTIONS + N_SELECTIONS + 1 + LATE_WORK) * MOST_LANES;
  sizes[3] = (long long) sizeof(struct search);
  sizes[4] = SHARED;
}

void symgraph_bind(struct member *me, const real *const *shared, real *block, real *work) {
  real *res[1];
  res[0] = block;
  early(shared, res, work, 1, me);
}

static struct lanes lanes_in(const struct given *given, real *work) {
  struct lanes lanes;
  lanes.x = work;
  lanes.gradient = lanes.x + N_ACTIONS * MOST_LANES;
  lanes.chosen = lanes.gradient + N_ACTIONS * MOST_LANES;
  lanes.value = lanes.chosen + N_SELECTIONS * MOST_LANES;
  lanes.given = given;
  return lanes;
}

/* Where workspace of the functions begins. */
static real *behind(real *work) { return work + (2 * N_ACTIONS + N_SELECTIONS + 1) * MOST_LANES; }

/* Values and gradients at points (count, N_ACTIONS), with selections (count, N_SELECTIONS); those with the same ones stand
   together. */
void symgraph_evaluate(struct member *me, long long count, const double *points, const double *chosen,
                       const real *const *shared, const volatile int *stop, double *values, double *gradients, real *work) {
  const struct given given = {shared, behind(work)};
  const struct lanes lanes = lanes_in(&given, work);
  struct team *const team = me->team;
  long long p = 0;
  while (p < count) {
    long n = 1, b, i;
    while (n < MOST_LANES && p + n < count &&
           !memcmp(chosen + p * N_SELECTIONS, chosen + (p + n) * N_SELECTIONS, N_SELECTIONS * sizeof(double)))
      ++n;
    if (me->index == 0) {
      const long B = team->lanes = p && *stop ? 0 : fill(n);
      for (b = 0; b < B; ++b) {
        const long long q = p + (b < n ? b : 0);
        for (i = 0; i < N_ACTIONS; ++i) lanes.x[i * B + b] = (real) points[q * N_ACTIONS + i];
        for (i = 0; i < N_SELECTIONS; ++i) lanes.chosen[i * B + b] = (real) chosen[q * N_SELECTIONS + i];
      }
    }
    meet(me);
    if (!team->lanes) break;
    evaluate(&lanes, team->lanes, me);
    if (me->index == 0) {
      const long B = team->lanes;
      for (b = 0; b < n; ++b) {
        values[p + b] = (double) lanes.value[b];
        for (i = 0; i < N_ACTIONS; ++i) gradients[(p + b) * N_ACTIONS + i] = (double) lanes.gradient[i * B + b];
      }
    }
    p += n;
  }
  for (; me->index == 0 && p < count; ++p) { /* time is over */
    long i;
    values[p] = NAN;
    for (i = 0; i < N_ACTIONS; ++i) gradients[p * N_ACTIONS + i] = NAN;
  }
}

/* Make one of `searches` that share points; those of which `outcomes` is UNDER_WAY have not ended. */
void symgraph_begin(struct search *all, const struct settings *set, long *next, long long searches, long long count,
                    const double *points, const double *chosen, const double *tolerances, const double *scales,
                    double *ends, double *values, double *histories, int *outcomes, long long *spent) {
  all->set = *set;
  all->count = (long) count;
  all->next = next;
  all->active = 0;
  all->most = fill((long) ((count + searches - 1) / searches));
  if (all->most > MOST_LANES) all->most = MOST_LANES;
  all->points = points;
  all->chosen = chosen;
  all->tolerances = tolerances;
  all->scales = scales;
  all->ends = ends;
  all->values = values;
  all->histories = histories;
  all->outcomes = outcomes;
  all->spent = spent;
}

/* Go on with a search for some rounds. */
void symgraph_advance(struct member *me, struct search *all, const real *const *shared, real *work, long long rounds) {
  const struct given given = {shared, behind(work)};
  const struct lanes lanes = lanes_in(&given, work);
  advance(me, all, &lanes, (long) rounds);
}
