// Compiled once per instruction set: GSMAP_ISA is the namespace and name, the compiler's flags choose the vectors.
#include "codes_kernel.h"
#include "correspondences_kernel.h"
#include "filters_kernel.h"
#include "fit_kernel.h"
#include "landmarks_kernel.h"
#include "matches_kernel.h"
#include "merging_kernel.h"
#include "rasteriser_blend.h"
#include "rasteriser_blend_backward.h"
#include "rasteriser_project_backward.h"
#include "sift_kernel.h"
#include "signatures_kernel.h"

#define GSMAP_STRING_(x) #x
#define GSMAP_STRING(x) GSMAP_STRING_(x)
#define GSMAP_JOIN_(a, b) a##b
#define GSMAP_JOIN(a, b) GSMAP_JOIN_(a, b)

static const gsmap::Kernels table = {GSMAP_STRING(GSMAP_ISA), GSMAP_ISA::project, GSMAP_ISA::blend, GSMAP_ISA::blend_more,
                                     GSMAP_ISA::blend_limit, GSMAP_ISA::blend_backward, GSMAP_ISA::project_backward,
                                     GSMAP_ISA::adam, GSMAP_ISA::huber, GSMAP_ISA::ssim, GSMAP_ISA::agree,
                                     GSMAP_ISA::vote, GSMAP_ISA::weigh, GSMAP_ISA::highest,
                                     GSMAP_ISA::peaks, GSMAP_ISA::polar, GSMAP_ISA::add_slopes, GSMAP_ISA::near,
                                     GSMAP_ISA::pair_costs, GSMAP_ISA::find_nearest, GSMAP_ISA::settle_nearest,
                                     GSMAP_ISA::within, GSMAP_ISA::blur_across, GSMAP_ISA::blur_along,
                                     GSMAP_ISA::nearest};
const gsmap::Kernels *gsmap::GSMAP_JOIN(kernels_, GSMAP_ISA) = &table;
