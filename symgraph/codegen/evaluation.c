/* The task at one point: J, the margins of requirements, and slopes; and what ends a search early. */

/* Take in what stays the same during a call. */
static void bind(Planner *p) {
  const real *arg[N_EARLY + 1];
  real *res[1];
  gather_early(p, arg);
  res[0] = p->block;
  early(arg, res, p->work);
}

static void choose(Planner *p, const int *choices) {
  int s, i, at = 0;
  for (s = 0; s < N_SELECTIONS; at += sizes[s++])
    for (i = 0; i < sizes[s]; ++i) p->chosen[at + i] = choices[s] == i;
}

/* Evaluate J and the margins at x. */
static void evaluate(Planner *p, const double *x, const int *choices) {
  const real *arg[N_GIVEN + 1];
  real *res[3];
  int i;
  for (i = 0; i < N_ACTIONS; ++i) p->actions[i] = (real) x[i];
  choose(p, choices);
  gather(p, arg);
  res[0] = p->result;
  res[1] = p->result_margins;
  res[2] = p->tape;
  forward(arg, res, p->work);
  p->value = (double) p->result[0];
  for (i = 0; i < N_MARGINS; ++i) p->margins[i] = (double) p->result_margins[i];
}

/* The gradient of J - pulls · margins at the point that was evaluated last. */
static void differentiate(Planner *p) {
  const real *arg[N_GIVEN + 2];
  real *res[1];
  int i;
  gather(p, arg);
  arg[N_GIVEN] = p->tape;
  res[0] = p->slopes;
  backward(arg, res, p->work);
  for (i = 0; i < N_ACTIONS; ++i) p->gradient[i] = (double) p->slopes[i];
}

/* Whether there is no time for one more evaluation, which may take as long as the last ones did. */
static int is_late(Planner *p) {
  double spent;
  if (!(p->options->seconds > 0)) return 0;
  spent = p->options->clock(p->options->user) - p->began;
  p->expected = larger(spent - p->spent, 0.9 * p->expected); /* the longest one, forgotten by and by: it may have been held up */
  p->spent = spent;
  return spent + p->expected >= p->options->seconds;
}

/* Whether the search may evaluate once more; the first time always. */
static int may_go_on(Planner *p) {
  const planner_options *o = p->options;
  if (p->over || p->plan->evaluations == 0) return !p->over;
  if (o->evaluations > 0 && p->plan->evaluations >= o->evaluations)
    p->over = PLANNER_EVALUATION_LIMIT;
  else if (is_late(p))
    p->over = PLANNER_TIME_LIMIT;
  else if (o->progress && o->progress(o->user, p->plan))
    p->over = PLANNER_INTERRUPTED;
  return !p->over;
}

/* Begin a round of samples and searches: budgets are shared out anew. */
static void begin_round(Planner *p) {
  const planner_options *o = p->options;
  p->round_evaluations = p->plan->evaluations;
  p->round_seconds = o->seconds > 0 ? o->clock(o->user) - p->began : 0;
}

/* Whether a share of the budget that was left when the round began is spent. */
static int has_spent(const Planner *p, double share) {
  const planner_options *o = p->options;
  if (o->evaluations > 0 && (double) (p->plan->evaluations - p->round_evaluations) >=
                                share * (double) (o->evaluations - p->round_evaluations))
    return 1;
  return o->seconds > 0 &&
         o->clock(o->user) - p->began - p->round_seconds >= share * (o->seconds - p->round_seconds);
}

#define SAME 1e-6 /* breaches that differ by less are equal */
#ifdef SINGLE
#define EQUAL 1e-6 /* and values */
#else
#define EQUAL 1e-12
#endif

/* Whether there is time for something that takes as long as so many evaluations. */
static int has_time_for(const Planner *p, double evaluations) {
  const planner_options *o = p->options;
  double spent;
  if (!(o->seconds > 0) || p->plan->evaluations == 0) return 1;
  spent = o->clock(o->user) - p->began;
  return spent + (1 + evaluations) * spent / (double) p->plan->evaluations < o->seconds;
}

#define FEWEST_OF_SEARCH 8 /* evaluations: fewer lead nowhere */

/* How many evaluations a search may take: under a budget a third of those that are left, since there are others. */
static long affordable(const Planner *p, long most) {
  const planner_options *o = p->options;
  const double done = (double) p->plan->evaluations;
  double left = (double) most * 3;
  if (o->evaluations > 0) left = smaller(left, (double) o->evaluations - done);
  if (o->seconds > 0 && done > 0) {
    const double spent = o->clock(o->user) - p->began;
    if (spent > 0) left = smaller(left, (o->seconds - spent) / spent * done);
  }
  return (long) larger(left / 3, FEWEST_OF_SEARCH < most ? FEWEST_OF_SEARCH : most);
}

/* Whether the order of searches matters, since there may not be time for all. */
static int is_limited(const Planner *p) { return p->options->seconds > 0 || p->options->evaluations > 0; }

/* Whether one result is better than another: it misses less, or as much and its value is higher. Values that differ by rounding
   alone are equal, so that of two searches the same one is taken on all machines. */
static int is_better(double value, double missed, double other_value, double other_missed) {
  if (missed > other_missed * (1 + SAME)) return 0;
  return other_missed > missed * (1 + SAME) || value > other_value + EQUAL * fabs(other_value);
}

static void keep(planner_plan *plan, const double *x, const int *choices, double value, double missed, double violation,
                 int worst) {
  memcpy(&plan->actions, x, N_ACTIONS * sizeof(double));
  memcpy(&plan->selections, choices, N_SELECTIONS * sizeof(int));
  plan->value = value;
  plan->missed = missed;
  plan->violation = violation;
  plan->worst = worst;
  plan->found = 1;
}

/* Evaluate at x during a search; the best of all such points is what is handed out when time is over. Returns whether J is
   finite there. */
static int look(Planner *p, const double *x, const int *choices) {
  planner_plan *plan = p->plan;
  double inside[N_ACTIONS + 1];
  int i;
  for (i = 0; i < N_ACTIONS; ++i) inside[i] = (double) within(x[i], p->low[i], p->high[i]);
  evaluate(p, inside, choices);
  ++plan->evaluations;
#if REQUIREMENTS
  p->missed = breach(p, choices, &p->violation, &p->worst);
#endif
  if (!isfinite(p->value)) return 0;
  if (p->missed >= 0 && (!plan->found || is_better(p->value, p->missed, plan->value, plan->missed)))
    keep(plan, inside, choices, p->value, p->missed, p->violation, p->worst);
  return 1;
}

/* How many combinations of the choices that are not held there are. */
static long combinations(const Planner *p) {
  double all = 1;
  int s;
  for (s = 0; s < N_SELECTIONS; ++s) all *= p->held[s] < 0 ? sizes[s] : 1;
  return all < MOST_COMBINATIONS ? (long) all : MOST_COMBINATIONS;
}

/* The combination of choices with a number; the first selection changes fastest. */
static void decode(const Planner *p, long code, int *choices) {
  int s;
  for (s = 0; s < N_SELECTIONS; ++s) {
    choices[s] = p->held[s];
    if (p->held[s] < 0) {
      choices[s] = (int) (code % sizes[s]);
      code /= sizes[s];
    }
  }
}

static int same_choices(const int *a, const int *b) { return N_SELECTIONS == 0 || !memcmp(a, b, N_SELECTIONS * sizeof(int)); }

static void copy_choices(int *to, const int *from) {
  int s;
  for (s = 0; s < N_SELECTIONS; ++s) to[s] = from[s];
}

static void copy_actions(double *to, const double *from) {
  int i;
  for (i = 0; i < N_ACTIONS; ++i) to[i] = from[i];
}
