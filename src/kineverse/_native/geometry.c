/* Near pairs of the objects of a scene: their distances, contact manifolds, and clearance along motions. */

#include "geometry/contact_manifold.h"
#include "geometry/conservative_advancement.h"
