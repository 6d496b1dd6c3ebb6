/* ADADELTA from many start points that wait in a queue. symgraph/optimizers/adadelta.py does the same. */

#define POLISHED 2 /* best runs of each combination of selections that are polished */
#define POLISH_ITERATIONS 200
#define CONSTRAINED_ITERATIONS 2000 /* where one climb follows the other until requirements are met */

/* Fill the queue: starts spread over choices and bounds, after those that are suggested. Returns how many wait. */
static int fill_queue(Planner *p) {
  struct room *const room = &p->room;
  int i, j, waiting = 0;
  for (i = 0; i < MOST_GUESSES + MOST_STARTS; ++i) room->starts[i].used = 0;
#if EVENLY
  if (combinations(p) > MOST_STARTS) { /* only the most promising have a start */
    find_promising(p, MOST_STARTS, SAMPLES);
  } else {
    draw_rows(p, MOST_STARTS, 1);
#else
  {
    draw_rows(p, MOST_STARTS, 0);
#endif
#if SPREAD
    spread_points(p, &p->draws, MOST_STARTS, p->low, p->high, room->points, room->scratch, room->keys, room->order);
#endif
    for (i = 0; i < MOST_STARTS; ++i) {
      struct start *here = room->starts + MOST_GUESSES + i;
      here->used = 1;
      copy_choices(here->choices, room->rows + i * N_SELECTIONS);
      for (j = 0; j < N_ACTIONS; ++j) {
        const double low = p->low[j], span = p->high[j] - p->low[j];
#if SPREAD
        const double x = room->points[i * N_ACTIONS + j];
#elif GAUSSIAN
        const double x = (low + p->high[j]) / 2 + span / 4 * normal(&p->draws);
#else
        const double x = low + span * uniform(&p->draws);
#endif
        here->x[j] = smaller(larger(x, low), low + span);
      }
    }
  }
  add_guesses(p);
  for (i = 0; i < MOST_GUESSES + MOST_STARTS; ++i)
    if (room->starts[i].used) {
      struct ended *one = room->ended + waiting++;
      copy_actions(one->x, room->starts[i].x);
      copy_actions(one->from, room->starts[i].x);
      copy_choices(one->choices, room->starts[i].choices);
      one->gradients = 0;
#if REQUEUE
      one->value = merit_at(p, one->x, one->choices, &j);
#endif
    }
  return waiting;
}

/* Take one point out of the queue: the next one, or, from a queue that points come back to, the best (0.4), a random one (0.3),
   or else the worst is dropped for a perturbed copy of the best finished point. */
static struct ended take_next(Planner *p, int *waiting, const struct ended *finished) {
  struct ended *const queue = p->room.ended;
  struct ended taken;
  int at = 0, i;
#if REQUEUE
  const double draw = uniform(&p->draws);
  if (draw < 0.4) {
    for (i = 1; i < *waiting; ++i)
      if (queue[i].value > queue[at].value) at = i;
  } else if (draw < 0.7 || !finished) {
    at = below(&p->draws, *waiting);
  } else {
    for (i = 1; i < *waiting; ++i)
      if (queue[i].value < queue[at].value) at = i;
    taken = *finished;
    for (i = 0; i < N_ACTIONS; ++i) {
      const double moved = taken.x[i] + 0.001 * (p->high[i] - p->low[i]) * normal(&p->draws);
      taken.x[i] = smaller(larger(moved, p->low[i]), p->high[i]);
    }
    copy_actions(taken.from, taken.x);
    taken.gradients = 0;
    queue[at] = taken;
  }
#else
  (void) p;
  (void) finished;
#endif
  taken = queue[at];
  --*waiting;
  for (i = at; i < *waiting; ++i) queue[i] = queue[i + 1];
  return taken;
}

/* Keep the best runs of each combination of selections for the polish. */
static void keep_for_polish(struct room *room, const struct ended *run) {
  int i, worst = -1, same = 0;
  if (!isfinite(run->value)) return;
  for (i = 0; i < room->polish_count; ++i)
    if (same_choices(room->polish[i].choices, run->choices)) {
      ++same;
      if (worst < 0 || room->polish[i].value <= room->polish[worst].value) worst = i;
    }
  if (same < POLISHED) {
    if (room->polish_count < MOST_POLISHED) room->polish[room->polish_count++] = *run;
  } else if (run->value > room->polish[worst].value) {
    room->polish[worst] = *run;
  }
}

/* Move a point by ADADELTA. Returns 0 if it had to end. */
static int move(Planner *p, struct ended *run, long limit) {
#if SCALED
  const struct known *here = knowledge_of(p, run->choices);
  const double scale = here->scale;
#else
#if REQUIREMENTS
  const struct known *here = knowledge_of(p, run->choices);
#endif
  const double scale = 1;
#endif
  int complete;
  p->settings.ascends = 1;
  p->settings.limit = limit + 1;
#if REQUIREMENTS
  first_weights(p, here->scale, here->units);
  complete = walk_on_merit(p, run->x, run->choices, TOLERANCE * scale, scale);
#else
  complete = walk_on_value(p, run->x, run->choices, TOLERANCE * scale, scale);
#endif
  if (!complete) return 0;
  if (run->gradients == 0) ++p->plan->starts;
  copy_actions(run->x, p->walk.x);
  run->value = p->walk.value;
  run->outcome = p->walk.outcome;
  run->gradients = (long) p->walk.spent;
  run->scale = scale;
  return 1;
}

static void optimize(Planner *p) {
  struct room *const room = &p->room;
  struct ended best;
  int waiting, finished = 0, i;
  int wanted;
  double total; /* of iterations; a long may be too short */
  long spent = 0;
  begin_round(p);
  waiting = fill_queue(p);
  wanted = FINISHED > 0 ? FINISHED : waiting;
  total = TOTAL_ITERATIONS > 0 ? (double) TOTAL_ITERATIONS : (double) waiting * RUN_ITERATIONS;
#if POLISH
  room->polish_count = 0;
#endif
  while (finished < wanted && waiting > 0 && (double) spent < total) {
#if REQUEUE
    const int batch = 1;
#else
    const double runs_left = ceil((total - (double) spent) / RUN_ITERATIONS);
    const int batch = (int) smaller(fewer(wanted - finished, waiting), runs_left);
#endif
    const long limit = (long) smaller(RUN_ITERATIONS, larger(1, floor((total - (double) spent) / batch)));
    for (i = 0; i < batch; ++i) {
      struct ended run = take_next(p, &waiting, finished ? &best : 0), judged;
      if (!may_go_on(p) || !move(p, &run, limit)) return;
      spent += run.gradients - 1;
#if POLISH
      keep_for_polish(room, &run);
#endif
      judged = run;
#if REQUIREMENTS
      if (!end_search(p, &judged, knowledge_of(p, run.choices))) return;
#else
      if (!end_search(p, &judged, 0)) return;
#endif
      if (run.outcome == CONVERGED || ((run.outcome == ITERATION_LIMIT || run.outcome == OSCILLATION) &&
                                       (!finished || !isfinite(best.value) || run.value > best.value))) {
        if (!finished || run.value > best.value) best = run;
        ++finished;
      }
#if REQUEUE
      if (run.outcome != NOT_FINITE) room->ended[waiting++] = run;
#endif
    }
  }
#if POLISH
  for (i = 0; i < room->polish_count; ++i) {
    struct ended polished;
    if (!climb_from(p, room->polish[i].x, room->polish[i].choices, 1e-9,
                    N_MARGINS ? CONSTRAINED_ITERATIONS : POLISH_ITERATIONS, &polished))
      return;
  }
#endif
}
