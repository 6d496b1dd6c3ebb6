/* Threads that carry out each evaluation together. All of them go through the same steps; of long arrays and of products
   with matrices of weights each does its own rows, and what is short the first one does alone. */
#ifdef __unix__
#include <sched.h>
#endif
#define ROWS_AT_ONCE 16 /* whole panels, and whole vectors */
#define SPINS 2000      /* looks at whether all have come, before the processor is left to others */

struct team {
  long threads;
  long arrived; /* at all meetings so far, summed over its members */
  long lanes;   /* what the first member says the next evaluation is of; 0: there is none */
  int broken;   /* not all have come, and they never will */
};

struct member {
  struct team *team;
  long index;
  long meetings;
  char apart[64]; /* so that no two members write to the same line of the cache */
};

/* Wait for the others. */
static void meet(struct member *me) {
  struct team *const team = me->team;
  long all, spins;
  if (team->threads == 1) return;
  all = ++me->meetings * team->threads;
  __atomic_add_fetch(&team->arrived, 1, __ATOMIC_ACQ_REL);
  for (spins = 0; __atomic_load_n(&team->arrived, __ATOMIC_ACQUIRE) < all; ++spins) {
    if (__atomic_load_n(&team->broken, __ATOMIC_RELAXED)) return;
#ifdef __unix__
    if (spins > SPINS) sched_yield();
#endif
  }
}

/* Where the rows of a member begin, or of one behind it. */
static inline long row_of(const struct member *me, long behind, long rows) {
  const long units = (rows + ROWS_AT_ONCE - 1) / ROWS_AT_ONCE;
  const long row = units * (me->index + behind) / me->team->threads * ROWS_AT_ONCE;
  return row < rows ? row : rows;
}
