/* The larger and the smaller of two numbers, inlined in place of the C library's, whose calls cost more than a network's
   other rectifications together. As there, NaN gives way to a number. */
#include <math.h>
static inline double symgraph_fmax(double x, double y) { return x > y || y != y ? x : y; }
static inline double symgraph_fmin(double x, double y) { return x < y || y != y ? x : y; }
#define fmax symgraph_fmax
#define fmin symgraph_fmin
