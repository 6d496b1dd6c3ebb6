/* Threads that carry out each evaluation together. All of them go through the same steps, each does those of its own parts,
   and they meet before one touches what another one has written. */
#ifdef __unix__
#include <sched.h>
#endif
#define SPINS 2000 /* looks at whether all have come, before the processor is left to others */

struct team {
  long threads;
  long arrived; /* at all meetings so far, summed over its members */
  long lanes;   /* what the first member says the next evaluation is of; 0: there is none */
  int broken;   /* not all have come, and they never will */
};

struct member {
  struct team *team;
  long index;
  unsigned parts; /* of a program that are its own, bit by bit */
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
