/* What a point leads to, node by node; and the best search whose value that bears out. */

/* Values and variances of the sum of rewards, from the leaves to the root: groups are independent, branches a mixture. */
static void sum_up(struct foresight *seen) {
  int i, j;
  for (i = 0; i < N_NODES; ++i) {
    seen->values[i] = is_cut[i] ? CUT_VALUE : (double) seen->rewards[i];
    seen->spreads[i] = is_cut[i] ? 0 : (double) seen->variances[i];
  }
  for (i = N_NODES - 1; i > 0; i = j) { /* the branches of a group stand side by side, after all their parents */
    double mean = 0, spread = 0;
    int g;
    for (j = i; j > 0 && groups[j] == groups[i]; --j) {
      const double share = (double) seen->shares[j];
      if (share != 0) mean += share * seen->values[j];
    }
    for (g = i; g > j; --g) {
      const double share = (double) seen->shares[g], apart = seen->values[g] - mean;
      if (share != 0) spread += share * (seen->spreads[g] + apart * apart);
    }
    seen->values[parents[i]] += mean;
    seen->spreads[parents[i]] += spread;
  }
}

static void look_ahead(Planner *p, const double *x, const int *choices) {
  struct foresight *const seen = &p->foresight;
  const real *arg[N_GIVEN + 1];
  real *res[4];
  int i;
  for (i = 0; i < N_ACTIONS; ++i) p->actions[i] = (real) x[i];
  choose(p, choices);
  gather_outcomes(p, arg);
  res[0] = seen->shares;
  res[1] = seen->rewards;
  res[2] = seen->variances;
  res[3] = seen->moments;
  foresee(arg, res, p->work);
  sum_up(seen);
}

#ifdef SINGLE
#define TOLD 1e-4 /* of a value: differences that are rounding */
#define TOLD_SCALE 1e-5
#else
#define TOLD 1e-7
#define TOLD_SCALE 1e-9 /* and of the size of differences of J that matter */
#endif

/* Leave the best search that has ended in the plan. Where a model jumps, a search may end on an edge where its own arithmetic
   alone stays: its value is then that which follows from the outcomes of the nodes, and perhaps another search is better.
   Returns 0 if there is none. */
static int settle(Planner *p) {
  struct room *const room = &p->room;
  for (;;) {
    struct ended *best = 0;
    double worth, rounding;
    int i;
    for (i = 0; i < room->done_count; ++i) {
      struct ended *one = room->done + i;
      if (isfinite(one->value) && (!best || is_better(one->value, one->missed, best->value, best->missed))) best = one;
    }
    if (!best) return 0;
    if (!may_go_on(p)) return 1;
    if (!best->told) {
      if (!has_time_for(p, FORESIGHT)) return 1;
      look_ahead(p, best->x, best->choices);
      worth = p->foresight.values[0] - (RISK != 0 ? RISK * sqrt(larger(p->foresight.spreads[0], 0)) : 0);
      rounding = TOLD * fabs(best->value) + TOLD_SCALE * best->scale;
      if (!(fabs(worth - best->value) <= rounding)) {
        best->value = isfinite(worth) ? worth : -INFINITY;
        best->told = 1;
        continue;
      }
    }
    keep(p->plan, best->x, best->choices, best->value, best->missed, best->violation, best->worst);
    return 1;
  }
}
