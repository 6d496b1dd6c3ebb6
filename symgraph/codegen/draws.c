/* Random numbers, the same ones as Python's from the same seed: symgraph/optimizers/draws.py and NumPy's SFC64. */

/* Chris Doty-Humphrey's "small fast chaotic" generator with 64 bits. */
struct draws {
  uint64_t a, b, c, counter;
};

static uint64_t next_draw(struct draws *d) {
  const uint64_t sum = d->a + d->b + d->counter++;
  d->a = d->b ^ (d->b >> 11);
  d->b = d->c + (d->c << 3);
  d->c = ((d->c << 24) | (d->c >> 40)) + sum;
  return sum;
}

static double uniform(struct draws *d) { return (double) (next_draw(d) >> 11) * (1.0 / 9007199254740992.0); }

/* What NumPy's SeedSequence does: it spreads the bits of a seed over as much state as is wanted (after O'Neill's seed_seq). */
static uint32_t hashed(uint32_t word, uint32_t *key, uint32_t factor) {
  word ^= *key;
  *key *= factor;
  word *= *key;
  return word ^ (word >> 16);
}

static void seed_draws(struct draws *d, uint64_t seed) {
  uint32_t pool[4], key = 0x43b0d7e5u, state[6];
  int i, j;
  for (i = 0; i < 4; ++i) pool[i] = hashed(i < 2 ? (uint32_t) (seed >> 32 * i) : 0u, &key, 0x931e8875u);
  for (i = 0; i < 4; ++i)
    for (j = 0; j < 4; ++j)
      if (i != j) {
        const uint32_t mixed = 0xca01f9ddu * pool[j] - 0x4973f715u * hashed(pool[i], &key, 0x931e8875u);
        pool[j] = mixed ^ (mixed >> 16);
      }
  key = 0x8b51f9ddu;
  for (i = 0; i < 6; ++i) state[i] = hashed(pool[i % 4], &key, 0x58f38dedu);
  d->a = state[0] | (uint64_t) state[1] << 32;
  d->b = state[2] | (uint64_t) state[3] << 32;
  d->c = state[4] | (uint64_t) state[5] << 32;
  d->counter = 1;
  for (i = 0; i < 12; ++i) next_draw(d);
}

static int below(struct draws *d, int count) { return (int) (uniform(d) * count); }

/* A standard normal number (Box & Muller 1958). */
static double normal(struct draws *d) {
  const double u = uniform(d), v = uniform(d);
  return sqrt(-2.0 * log1p(-u)) * cos(2.0 * 3.14159265358979323846 * v);
}

/* Sort indices so that keys[index] falls, or rises if `up`; of equal ones the first comes first. */
static void sort_indices(int *indices, int count, const double *keys, int up) {
  int gap = 1, i, j;
  while (gap < count / 3) gap = 3 * gap + 1;
  for (; gap > 0; gap /= 3)
    for (i = gap; i < count; ++i) {
      const int index = indices[i];
      for (j = i; j >= gap; j -= gap) {
        const int other = indices[j - gap];
        const double a = keys[index], b = keys[other];
        if (!(a == b ? index < other : up ? a < b : a > b)) break;
        indices[j] = other;
      }
      indices[j] = index;
    }
}

/* Whether time is over, for what takes long between evaluations. */
static int is_late(struct planner_planner *p);

/* Points (count, N_ACTIONS) of a Latin hypercube between bounds (McKay, Beckman & Conover 1979). `scratch` has room for as
   many numbers as points, `keys` and `order` for `count`. When time is over the rest is not shuffled. */
static void spread_points(struct planner_planner *p, struct draws *d, int count, const double *low, const double *high,
                          double *points, double *scratch, double *keys, int *order) {
  int late = 0, i, r;
  for (r = 0; r < count * N_ACTIONS; ++r) points[r] = uniform(d);
  for (r = 0; r < count * N_ACTIONS; ++r) scratch[r] = uniform(d);
  for (i = 0; i < N_ACTIONS; ++i) {
    for (r = 0; r < count; ++r) {
      keys[r] = scratch[r * N_ACTIONS + i];
      order[r] = r;
    }
    late = late || is_late(p);
    if (!late) sort_indices(order, count, keys, 1);
    for (r = 0; r < count; ++r) {
      double *x = points + r * N_ACTIONS + i;
      *x = low[i] + (high[i] - low[i]) * ((order[r] + *x) / count);
      *x = smaller(larger(*x, low[i]), high[i]);
    }
  }
}

/* Different whole numbers below `total`, in the order in which they are drawn (Floyd: Bentley & Floyd 1987). */
static void distinct(struct draws *d, int total, int count, int *numbers) {
  int i, j;
  for (i = 0; i < count; ++i) {
    const int last = total - count + i, drawn = (int) (uniform(d) * (last + 1));
    for (j = 0; j < i && numbers[j] != drawn; ++j) continue;
    numbers[i] = j < i ? last : drawn;
  }
}
