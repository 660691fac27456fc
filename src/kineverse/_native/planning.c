/* Motion planning in float: collision checks, edges, trees, roadmaps, manifolds. */

#define KINEVERSE_FLOAT
#include "planning/manifold.h"
#include "planning/roadmap.h"
