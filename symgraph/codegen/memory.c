/* The memory of a planner. */

struct start {
  double x[N_ACTIONS + 1], merit;
  int choices[N_SELECTIONS + 1], fits, used;
};

/* What is known of a combination of choices: the size of the differences of J that matter, and of margins. */
struct known {
  double scale, units[N_MARGINS + 1];
  int choices[N_SELECTIONS + 1], filled;
};

/* A search that has ended: where, and what is missed there; -1: it cannot be judged. */
struct ended {
  double x[N_ACTIONS + 1], from[N_ACTIONS + 1], value, missed, violation, scale;
  int choices[N_SELECTIONS + 1], outcome, told, worst;
  long gradients;
};

/* What a search keeps. */
struct room {
  /* samples of one combination of choices */
  double points[MOST_SAMPLES * N_ACTIONS + 1], scratch[MOST_SAMPLES * N_ACTIONS + 1], keys[MOST_SAMPLES];
  double values[MOST_SAMPLES], merits[MOST_SAMPLES], penalties[MOST_SAMPLES];
  int order[MOST_SAMPLES], ranks[MOST_SAMPLES], picked[MOST_SAMPLES], fitting[MOST_SAMPLES];
  /* combinations of choices: those that are sampled, and what is known of some */
  int rows[ROWS * N_SELECTIONS + 1], numbers[ROWS];
  double typical[SCALE_SAMPLES * N_ACTIONS + 1], typical_scratch[SCALE_SAMPLES * N_ACTIONS + 1], column[SCALE_SAMPLES], margins[SCALE_SAMPLES * N_MARGINS + 1];
  struct known known[KNOWN];
  int next_known, has_typical, typical_order[SCALE_SAMPLES];
  /* points that wait, those that are suggested first; searches that have ended */
  struct start starts[MOST_GUESSES + MOST_STARTS];
  struct ended ended[MOST_GUESSES + MOST_STARTS], polish[MOST_POLISHED];
  int polish_count;
  int ended_count, tried_count, tried[MOST_TRIED * N_SELECTIONS + 1];
  struct ended done[MOST_DONE]; /* the best ones */
  int done_count;
  /* neighbours of a combination: a selection, its choice, and how promising they are */
  int near[N_CHOICES + 1][2], near_fits[N_CHOICES + 1];
  double near_merits[N_CHOICES + 1];
  /* of a climb that keeps requirements */
  double multipliers[N_MARGINS + 1], weights[N_MARGINS + 1], pulled[N_MARGINS + 1], found_breaches[N_MARGINS + 1],
      slack[N_MARGINS + 1], at_end[N_MARGINS + 1];
  double point[N_ACTIONS + 1], kept_point[N_ACTIONS + 1], moved[N_ACTIONS + 1];
};

/* The outcomes of all nodes. */
struct foresight {
  real shares[N_NODES], rewards[N_NODES], variances[N_NODES], moments[N_MOMENTS + 1];
  double values[N_NODES], spreads[N_NODES]; /* of the rewards from there on */
};

/* All that a planner keeps, in the memory that the caller hands in. */
struct planner_planner {
  unsigned mark; /* that it was begun */
  const real *weights;
  const planner_options *options; /* of the call under way, else 0 */
  planner_plan *plan;             /* the best so far */
  int over;                       /* why the search has to end; 0 while it may go on */
  double began, spent, expected;  /* [s] by the caller's clock: begin, at the last look, what an evaluation takes */
  double round_seconds;           /* of the budget that were spent when this round of samples began */
  long round_evaluations;
  int cut_short;                  /* whether the budget ended this round's samples */
  struct draws draws;
  double low[N_ACTIONS + 1], high[N_ACTIONS + 1];
  int held[N_SELECTIONS + 1]; /* the choice that is held, or -1 */
  /* what is told of the point that was looked at last */
  double value, margins[N_MARGINS + 1], gradient[N_ACTIONS + 1];
  double missed, violation; /* by how much requirements are, rounding left out, and at all */
  int worst;                /* which one is missed most, or -1 */
  /* inputs, results and workspace of the generated functions */
  real actions[N_ACTIONS + 1], chosen[N_CHOICES + 1], state[N_STATE + 1], pulls[N_MARGINS + 1];
  real result[1], result_margins[N_MARGINS + 1], slopes[N_ACTIONS + 1];
  real block[BLOCK + 1], tape[TAPE + 1], work[WORK + 1];
  struct settings settings;
  int never; /* what would end a walk at once */
  struct walk walk;
  struct room room;
  struct foresight foresight;
};

typedef struct planner_planner Planner;
