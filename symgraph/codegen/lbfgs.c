/* Multi-start L-BFGS: sample widely, climb from the most promising samples. symgraph/optimizers/lbfgs.py does the same. */

#define MOST_NEIGHBOURS 8 /* of a combination of selections that are climbed in at once */

#if IMPROVES
static int was_tried(const struct room *room, const int *choices) {
  int t;
  for (t = 0; t < room->tried_count; ++t)
    if (same_choices(room->tried + t * N_SELECTIONS, choices)) return 1;
  return 0;
}

/* Go on from a climb to better neighbours, combinations that differ in one selection. Returns 0 if it had to end. */
static int improve(Planner *p, struct ended best) {
  struct room *const room = &p->room;
  int s, c, n, went_on = 1;
  while (went_on) {
    struct ended before = best;
    int count = 0, choices[N_SELECTIONS + 1];
    went_on = 0;
    for (s = 0; s < N_SELECTIONS; ++s)
      for (c = 0; c < sizes[s] && p->held[s] < 0; ++c) {
        copy_choices(choices, before.choices);
        choices[s] = c;
        if (was_tried(room, choices)) continue;
        if (!may_go_on(p)) return 0;
        room->near[count][0] = s;
        room->near[count][1] = c;
        room->near_merits[count] = merit_at(p, before.x, choices, room->near_fits + count);
        ++count;
      }
    for (n = 0; n < MOST_NEIGHBOURS && n < count; ++n) { /* the most promising ones, one after the other */
      struct ended made;
      int first = -1;
      for (c = 0; c < count; ++c)
        if (room->near[c][0] >= 0 &&
            (first < 0 || room->near_fits[c] > room->near_fits[first] ||
             (room->near_fits[c] == room->near_fits[first] && room->near_merits[c] > room->near_merits[first])))
          first = c;
      copy_choices(choices, before.choices);
      choices[room->near[first][0]] = room->near[first][1];
      room->near[first][0] = -1;
      if (room->tried_count == MOST_TRIED) return 1;
      ++p->plan->starts;
      if (!climb_from(p, before.x, choices, TOLERANCE, ITERATIONS, &made)) return 0;
      if (isfinite(made.value) && made.missed >= 0 && is_better(made.value, made.missed, best.value, best.missed)) {
        best = made;
        went_on = 1;
      }
    }
  }
  return 1;
}

#endif
/* The start that is next, or -1: the first one that waits, or the most promising one where there may not be time for all. */
static int next_start(const Planner *p) {
  const struct start *starts = p->room.starts;
  int i, next = -1;
  for (i = 0; i < MOST_GUESSES + MOST_STARTS; ++i)
    if (starts[i].used && (next < 0 || comes_before(starts + i, starts + next))) {
      next = i;
      if (i < MOST_GUESSES || !is_limited(p)) break; /* what the caller suggests comes first */
    }
  return next;
}

/* Climb from all starts that wait. Returns 0 if it had to end. */
static int climb_all(Planner *p) {
  struct room *const room = &p->room;
  int i;
  while (may_go_on(p) && (i = next_start(p)) >= 0) {
    struct ended made;
    room->starts[i].used = 0;
    ++p->plan->starts;
    if (!climb_from(p, room->starts[i].x, room->starts[i].choices, TOLERANCE, affordable(p, ITERATIONS), &made)) return 0;
#if IMPROVES
    if (isfinite(made.value) && made.missed >= 0 && room->ended_count < MOST_GUESSES + MOST_STARTS)
      room->ended[room->ended_count++] = made;
#endif
  }
  return !p->over;
}

static void optimize(Planner *p) {
  struct room *const room = &p->room;
  int i;
  for (i = 0; i < MOST_GUESSES + MOST_STARTS; ++i) room->starts[i].used = 0;
  room->ended_count = 0;
  begin_round(p);
  if (is_limited(p)) { /* what the caller suggests comes first, then rounds of few samples and the climbs from them */
    int suggested;
    add_guesses(p);
    if (!climb_all(p)) return;
    suggested = p->plan->starts;
    do {
      begin_round(p);
      find_promising(p, STARTS, SAMPLES);
      if (!climb_all(p)) return;
    } while (!ENUMERATES && (p->cut_short || p->plan->starts - suggested < STARTS));
  } else {
    find_promising(p, STARTS, SAMPLES);
    add_guesses(p);
    if (!climb_all(p)) return;
  }
#if IMPROVES
  if (combinations(p) > STARTS)
    for (i = 0; i < room->ended_count; ++i)
      if (!improve(p, room->ended[i])) return;
#endif
}
