/* A search from one start point, what becomes of it, and when all of them are over. */

/* Forget what an earlier search kept; to clear all of it would take long. */
static void forget(struct room *room) {
  int i;
  for (i = 0; i < KNOWN; ++i) room->known[i].filled = 0;
  room->next_known = room->has_typical = room->ended_count = room->polish_count = 0;
  room->done_count = room->tried_count = 0;
}

/* Note that a combination of choices was searched; returns 0 if there is no room to note more. */
static int note_tried(struct room *room, const int *choices) {
  int t;
  for (t = 0; t < room->tried_count; ++t)
    if (same_choices(room->tried + t * N_SELECTIONS, choices)) return 1;
  if (t == MOST_TRIED) return 0;
  copy_choices(room->tried + t * N_SELECTIONS, choices);
  ++room->tried_count;
  return 1;
}

#if !REQUIREMENTS
/* Walk from x where the walk's settings lead, on J. Returns 0 if it had to end. */
static int walk_on_value(Planner *p, const double *x, const int *choices, double tolerance, double scale) {
  struct walk *const walk = &p->walk;
  int goes_on = 1;
  begin_walk(walk, &p->settings, x, tolerance, scale, 0);
  while (goes_on && may_go_on(p)) {
    look(p, walk->x, choices);
    differentiate(p);
    goes_on = (p->settings.ascends ? ascend : climb)(walk, &p->settings, p->value, p->gradient);
  }
  end_walk(walk, &p->settings);
  return !goes_on;
}

#endif
/* Keep a search that has ended, if need be instead of the worst one that is kept. */
static void keep_done(struct room *room, const struct ended *made) {
  int i, worst = 0;
  if (room->done_count < MOST_DONE) {
    room->done[room->done_count++] = *made;
    return;
  }
  for (i = 1; i < MOST_DONE; ++i)
    if (is_better(room->done[worst].value, room->done[worst].missed, room->done[i].value, room->done[i].missed)) worst = i;
  if (!is_better(made->value, made->missed, room->done[worst].value, room->done[worst].missed)) return;
  for (i = worst; i < MOST_DONE - 1; ++i) room->done[i] = room->done[i + 1]; /* in order: of equals the first one counts */
  room->done[i] = *made;
}

/* Judge where a walk has ended, and keep it. Returns 0 if the search had to end before. */
static int end_search(Planner *p, struct ended *made, const struct known *here) {
  struct room *const room = &p->room;
  const planner_options *o = p->options;
  planner_plan *plan = p->plan;
#if REQUIREMENTS
  made->missed = judged_breach(p, made->x, made->choices, here->units, &made->value, &made->violation, &made->worst);
  if (p->over) return 0;
#else
  (void) here;
  made->missed = made->violation = 0;
  made->worst = -1;
#endif
  if (o->runs && plan->runs < o->run_room) {
    planner_run *run = o->runs + plan->runs;
    memcpy(&run->start, made->from, N_ACTIONS * sizeof(double));
    memcpy(&run->actions, made->x, N_ACTIONS * sizeof(double));
    memcpy(&run->selections, made->choices, N_SELECTIONS * sizeof(int));
    run->value = made->value;
    run->missed = made->missed;
    run->outcome = made->outcome;
    run->gradients = made->gradients;
  }
  ++plan->runs;
  plan->gradients += made->gradients;
  note_tried(room, made->choices);
  plan->tried = room->tried_count;
  made->told = 0;
  if (isfinite(made->value) && made->missed >= 0) keep_done(room, made);
  return 1;
}

/* Climb from a point by L-BFGS. Returns 0 if it had to end. */
static int climb_from(Planner *p, const double *x, const int *choices, double tolerance, long iterations, struct ended *made) {
  const struct known *here = knowledge_of(p, choices);
  struct walk *const walk = &p->walk;
  int complete;
  p->settings.ascends = 0;
  p->settings.limit = iterations;
  copy_actions(made->from, x);
  copy_choices(made->choices, choices);
#if REQUIREMENTS
  complete = climb_within(p, x, choices, tolerance, here->scale, here->units, iterations, &made->gradients);
#else
  complete = walk_on_value(p, x, choices, tolerance * here->scale, 1);
  made->gradients = (long) walk->spent;
#endif
  if (!complete) return 0;
  copy_actions(made->x, walk->x);
  made->value = walk->value;
  made->outcome = walk->outcome;
  made->scale = here->scale;
  return end_search(p, made, here);
}
