/* What the caller calls. */

#define BEGUN 0x53474350u
#define REAL_BITS (8 * sizeof(real))

typedef char memory_suffices[sizeof(Planner) <= PLANNER_MEMORY ? 1 : -1];

struct aligned {
  char byte;
  Planner planner;
};

#if WEIGHTS_FILE
/* CRC-32 (ISO 3309), four bits at a time: its table is short. */
static uint32_t checksum(const unsigned char *bytes, size_t count) {
  static const uint32_t table[16] = {0x00000000u, 0x1db71064u, 0x3b6e20c8u, 0x26d930acu, 0x76dc4190u, 0x6b6b51f4u,
                                     0x4db26158u, 0x5005713cu, 0xedb88320u, 0xf00f9344u, 0xd6d6a3e8u, 0xcb61b38cu,
                                     0x9b64c2b0u, 0x86d3d2d4u, 0xa00ae278u, 0xbdbdf21cu};
  uint32_t sum = 0xffffffffu;
  size_t i;
  for (i = 0; i < count; ++i) {
    sum = table[(sum ^ bytes[i]) & 15u] ^ (sum >> 4);
    sum = table[(sum ^ (uint32_t) (bytes[i] >> 4)) & 15u] ^ (sum >> 4);
  }
  return sum ^ 0xffffffffu;
}

static uint32_t word(const unsigned char *bytes) {
  return bytes[0] | (uint32_t) bytes[1] << 8 | (uint32_t) bytes[2] << 16 | (uint32_t) bytes[3] << 24;
}

/* Check a file of weights: 8 bytes that say what it is, words for its version, the bits of a number, how many there are, what
   task they are for, the checksum of the numbers, the checksum of all this; then the numbers. */
static int weights_in(const void *weights, size_t bytes, const real **numbers) {
  const unsigned char *file = (const unsigned char *) weights;
  const real one = 1;
  unsigned char first;
  if (!file) return PLANNER_NULL;
  if (bytes < 32) return PLANNER_WEIGHTS_LENGTH;
  if (memcmp(file, "SGWEIGHT", 8) || checksum(file, 28) != word(file + 28)) return PLANNER_WEIGHTS_DAMAGED;
  if (word(file + 8) != 1 || word(file + 12) != REAL_BITS || word(file + 16) != N_WEIGHTS || word(file + 20) != TASK)
    return PLANNER_WEIGHTS_OTHER;
  if (bytes != 32 + (size_t) N_WEIGHTS * sizeof(real)) return PLANNER_WEIGHTS_LENGTH;
  memcpy(&first, &one, 1);
  if (first != 0) return PLANNER_WEIGHTS_OTHER; /* the file has the lowest byte first, this machine has not */
  if ((size_t) file % sizeof(real)) return PLANNER_MISALIGNED;
  if (checksum(file + 32, bytes - 32) != word(file + 24)) return PLANNER_WEIGHTS_DAMAGED;
  *numbers = (const real *) (const void *) (file + 32);
  return PLANNER_OK;
}
#endif

int planner_begin(PLANNER_BEGIN_ARGUMENTS) {
  Planner *p = (Planner *) memory;
  const size_t alignment = offsetof(struct aligned, planner);
  const real *numbers = 0;
  if (!memory || !planner) return PLANNER_NULL;
  *planner = 0;
  if (bytes < PLANNER_MEMORY) return PLANNER_MEMORY_TOO_SMALL;
  if ((size_t) memory % alignment) return PLANNER_MISALIGNED;
#if WEIGHTS_FILE
  {
    const int wrong = weights_in(weights, weights_bytes, &numbers);
    if (wrong) return wrong;
  }
#else
  numbers = constants;
#endif
  memset(p, 0, sizeof *p);
  p->weights = numbers;
  p->mark = BEGUN;
  *planner = p;
  return PLANNER_OK;
}

/* Begin a call: take in the state. */
static int take_state(Planner *p, const planner_state *state) {
  double numbers[N_STATE + 1] = {0};
  int i;
#if UNCERTAIN
  int c, j, size;
#endif
  if (!p || !state) return PLANNER_NULL;
  if (p->mark != BEGUN) return PLANNER_NOT_BEGUN;
  if (p->options) return PLANNER_BUSY;
  memcpy(numbers, state, N_STATE * sizeof(double));
  for (i = 0; i < N_STATE; ++i) {
    p->state[i] = (real) numbers[i];
    if (!isfinite(p->state[i])) return PLANNER_STATE_NOT_FINITE;
  }
#if UNCERTAIN
  for (c = 0; c < N_COVARIANCES; ++c) { /* each pair of elements is looked at */
    const double *const matrix = numbers + covariances[c][0];
    double rounding = 0;
    size = covariances[c][1];
    for (i = 0; i < size * size; ++i) rounding = larger(rounding, 1e-9 * fabs(matrix[i]));
    for (i = 0; i < size; ++i) {
      if (matrix[i * (size + 1)] < -rounding) return PLANNER_COVARIANCE;
      for (j = 0; j < i; ++j) {
        const double a = matrix[i + j * size], b = matrix[j + i * size];
        const double bound = larger(matrix[i * (size + 1)], 0) * larger(matrix[j * (size + 1)], 0);
        if (fabs(a - b) > rounding || fabs(a) > sqrt(bound) * (1 + 1e-6) + rounding) return PLANNER_COVARIANCE;
      }
    }
  }
#endif
  bind(p);
  return PLANNER_OK;
}

/* Take in actions and choices of a caller: all of them, or with NAN and -1 for what is left open. */
static int take_point(const planner_actions *actions, const planner_selections *selections, int open, int outside, double *x,
                      int *choices) {
  int i, s;
  if ((N_ACTIONS > 0 && !actions) || (N_SELECTIONS > 0 && !selections)) return PLANNER_NULL;
  if (N_ACTIONS > 0) memcpy(x, actions, N_ACTIONS * sizeof(double));
  if (N_SELECTIONS > 0) memcpy(choices, selections, N_SELECTIONS * sizeof(int));
  for (i = 0; i < N_ACTIONS; ++i) {
    if (open && x[i] != x[i]) continue;
    if (!isfinite((real) x[i])) return PLANNER_ACTION;
    if (!outside && (x[i] < lower[i] || x[i] > upper[i])) return PLANNER_ACTION;
  }
  for (s = 0; s < N_SELECTIONS; ++s)
    if (choices[s] < (open ? -1 : 0) || choices[s] >= sizes[s]) return PLANNER_CHOICE;
  return PLANNER_OK;
}

static int check_options(const planner_options *o) {
  double x[N_ACTIONS + 1];
  int choices[N_SELECTIONS + 1], i, wrong;
  if (o->evaluations < 0 || !(o->seconds >= 0) || (o->seconds > 0 && !o->clock)) return PLANNER_OPTION;
  if (o->start_count < 0 || o->start_count > MOST_GUESSES || o->run_room < 0) return PLANNER_OPTION;
  if ((o->start_count > 0 && !o->starts) || (o->run_room > 0 && !o->runs)) return PLANNER_NULL;
  for (i = 0; i < o->start_count; ++i) {
    wrong = take_point(&o->starts[i].actions, &o->starts[i].selections, 1, 0, x, choices);
    if (wrong) return wrong;
  }
  return o->held ? take_point(&o->held->actions, &o->held->selections, 1, 0, x, choices) : PLANNER_OK;
}

/* Search under what is held. */
static void search(Planner *p) {
#if ENUMERATES
  const long all = combinations(p);
  int held[N_SELECTIONS + 1], choices[N_SELECTIONS + 1];
  long code;
  copy_choices(held, p->held);
  for (code = 0; code < all && may_go_on(p); ++code) {
    copy_choices(p->held, held);
    decode(p, code, choices);
    copy_choices(p->held, choices);
    optimize(p);
  }
#else
  optimize(p);
#endif
}

int planner_solve(planner_planner *p, const planner_state *state, const planner_options *options, planner_plan *plan) {
  planner_options none;
  double began;
  int wrong, i, s;
  if (!p || !plan) return PLANNER_NULL;
  memset(&none, 0, sizeof none);
  if (!options) options = &none;
  wrong = check_options(options);
  if (wrong) return wrong;
  began = options->clock ? options->clock(options->user) : 0;
  wrong = take_state(p, state);
  if (wrong) return wrong;
  memset(plan, 0, sizeof *plan);
  forget(&p->room);
  p->options = options;
  p->plan = plan;
  p->over = 0;
  p->worst = -1;
  p->began = began;
  p->spent = p->expected = 0;
  for (i = 0; i < N_ACTIONS; ++i) {
    p->low[i] = lower[i];
    p->high[i] = upper[i];
    if (options->held) {
      const double x = ((const double *) (const void *) &options->held->actions)[i];
      if (x == x) p->low[i] = p->high[i] = x;
    }
  }
  for (s = 0; s < N_SELECTIONS; ++s)
    p->held[s] = options->held ? ((const int *) (const void *) &options->held->selections)[s] : -1;
  p->settings.low = p->low;
  p->settings.high = p->high;
  p->settings.stop = &p->never;
  p->settings.decay = DECAY;
  p->settings.epsilon = EPSILON;
  p->settings.oscillation = OSCILLATIONS;
  p->settings.scaled = SCALED_STEPS;
  p->settings.keep_best = KEEP_BEST;
  seed_draws(&p->draws, options->seed);
  search(p);
  if (!settle(p) && !p->over) plan->found = 0; /* samples alone had finite values */
  p->options = 0;
  if (options->clock) plan->seconds = options->clock(options->user) - p->began;
  return plan->found ? p->over : PLANNER_NO_PLAN;
}

/* Evaluate where the caller says. */
static int evaluate_at(Planner *p, const planner_state *state, const planner_actions *actions,
                       const planner_selections *selections, int *choices) {
  double x[N_ACTIONS + 1];
  int wrong = take_point(actions, selections, 0, 1, x, choices);
  if (!wrong) wrong = take_state(p, state);
  if (!wrong) evaluate(p, x, choices);
  return wrong;
}

int planner_value(planner_planner *p, const planner_state *state, const planner_actions *actions,
                  const planner_selections *selections, double *value) {
  int choices[N_SELECTIONS + 1];
  const int wrong = value ? evaluate_at(p, state, actions, selections, choices) : PLANNER_NULL;
  if (!wrong) *value = p->value;
  return wrong;
}

int planner_gradient(planner_planner *p, const planner_state *state, const planner_actions *actions,
                     const planner_selections *selections, double *value, planner_actions *gradient) {
  int choices[N_SELECTIONS + 1], k;
  const int wrong = value && gradient ? evaluate_at(p, state, actions, selections, choices) : PLANNER_NULL;
  if (wrong) return wrong;
  for (k = 0; k < N_MARGINS; ++k) p->pulls[k] = 0;
  differentiate(p);
  *value = p->value;
  memcpy(gradient, p->gradient, N_ACTIONS * sizeof(double));
  return PLANNER_OK;
}

#if REQUIREMENTS
int planner_violation(planner_planner *p, const planner_state *state, const planner_actions *actions,
                      const planner_selections *selections, double *violation) {
  int choices[N_SELECTIONS + 1], worst;
  const int wrong = violation ? evaluate_at(p, state, actions, selections, choices) : PLANNER_NULL;
  if (!wrong && breach(p, choices, violation, &worst) < 0) *violation = NAN;
  return wrong;
}

#endif
int planner_foresee(planner_planner *p, const planner_state *state, const planner_actions *actions,
                    const planner_selections *selections, planner_outcomes *outcomes) {
  const struct foresight *seen;
  double x[N_ACTIONS + 1];
  int choices[N_SELECTIONS + 1], wrong, i;
  if (!outcomes) return PLANNER_NULL;
  wrong = take_point(actions, selections, 0, 1, x, choices);
  if (!wrong) wrong = take_state(p, state);
  if (wrong) return wrong;
  look_ahead(p, x, choices);
  seen = &p->foresight;
  for (i = 0; i < N_NODES; ++i) {
    const double before = i ? outcomes->probability[parents[i]] : 1;
    outcomes->probability[i] = before != 0 ? before * (double) seen->shares[i] : 0; /* not 0 times NaN */
    outcomes->reward[i] = (double) seen->rewards[i];
    outcomes->value[i] = seen->values[i];
    outcomes->deviation[i] = sqrt(larger(seen->spreads[i], 0));
  }
  for (i = 0; i < N_MOMENTS; ++i) outcomes->moments[i] = (double) seen->moments[i];
  return PLANNER_OK;
}

/* Where a label was written last on the way to a node: its place in `writes`, or -1. */
static int last_write(int node, int label) {
  int i;
  for (;; node = parents[node]) {
    if (node < 0 || node >= N_NODES) return -1;
    for (i = write_begins[node]; i < write_begins[node + 1]; ++i)
      if (writes[i][0] == label) return i;
    if (node == 0) return -1;
  }
}

const double *planner_mean(const planner_outcomes *outcomes, int node, int label) {
  const int i = outcomes ? last_write(node, label) : -1;
  return i < 0 ? 0 : outcomes->moments + writes[i][1];
}

const double *planner_covariance(const planner_outcomes *outcomes, int node, int label) {
  const int i = outcomes ? last_write(node, label) : -1;
  return i < 0 || writes[i][2] < 0 ? 0 : outcomes->moments + writes[i][2];
}

const char *planner_message(int status) {
  switch (status) {
    case PLANNER_OK: return "ok";
    case PLANNER_TIME_LIMIT: return "time is over: the best plan so far";
    case PLANNER_EVALUATION_LIMIT: return "the evaluations are spent: the best plan so far";
    case PLANNER_INTERRUPTED: return "the caller ended the search: the best plan so far";
    case PLANNER_NO_PLAN: return "no point with a finite value was found";
    case PLANNER_NULL: return "a pointer that must be given is null";
    case PLANNER_MEMORY_TOO_SMALL: return "the memory is smaller than PLANNER_MEMORY";
    case PLANNER_MISALIGNED: return "memory or weights do not begin where numbers may: align them as a double";
    case PLANNER_NOT_BEGUN: return "this is no planner that was begun";
    case PLANNER_BUSY: return "this planner is searching: take another one, or wait";
    case PLANNER_STATE_NOT_FINITE: return "a number of the state is not finite";
    case PLANNER_COVARIANCE: return "a covariance of the state is not symmetric, or no covariance";
    case PLANNER_ACTION: return "an action is not finite or, as a start or held, out of its bounds";
    case PLANNER_CHOICE: return "a selection has no such choice";
    case PLANNER_OPTION: return "an option is negative, too large, or time is limited without a clock";
    case PLANNER_WEIGHTS_LENGTH: return "the weights are cut short, or too long";
    case PLANNER_WEIGHTS_DAMAGED: return "the weights are damaged: their checksum is wrong";
    case PLANNER_WEIGHTS_OTHER: return "these are weights of another task, version, precision or byte order";
    default: return "no such status";
  }
}
