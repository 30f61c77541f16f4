// The one extension module of gsmap. Each kernel binds itself from its own file; this one only lists them.
#include <nanobind/nanobind.h>

#include "clique.h"

namespace nb = nanobind;

namespace gsmap {
void bind_cells(nb::module_ &);
void bind_clusters(nb::module_ &);
void bind_codes(nb::module_ &);
void bind_correspondences(nb::module_ &);
void bind_filters(nb::module_ &);
void bind_fit(nb::module_ &);
void bind_groups(nb::module_ &);
void bind_landmarks(nb::module_ &);
void bind_laying(nb::module_ &);
void bind_matches(nb::module_ &);
void bind_merging(nb::module_ &);
void bind_moves(nb::module_ &);
void bind_parts(nb::module_ &);
void bind_pictures(nb::module_ &);
void bind_quaternions(nb::module_ &);
void bind_rasteriser(nb::module_ &);
void bind_rays(nb::module_ &);
void bind_sift(nb::module_ &);
void bind_signatures(nb::module_ &);
void bind_stopping(nb::module_ &);
void bind_surroundings(nb::module_ &);
void bind_surface(nb::module_ &);
}

NB_MODULE(_native, m) {
    m.doc() = "Kernels that decide gsmap's speed: rasteriser, consistency graphs, maximum clique and surfaces.";
    bind_clique(m);
    nb::set_leak_warnings(false);  // a view kept alive by an autograd graph at exit is no leak
    gsmap::bind_cells(m);
    gsmap::bind_clusters(m);
    gsmap::bind_codes(m);
    gsmap::bind_correspondences(m);
    gsmap::bind_filters(m);
    gsmap::bind_fit(m);
    gsmap::bind_groups(m);
    gsmap::bind_landmarks(m);
    gsmap::bind_laying(m);
    gsmap::bind_matches(m);
    gsmap::bind_merging(m);
    gsmap::bind_moves(m);
    gsmap::bind_parts(m);
    gsmap::bind_pictures(m);
    gsmap::bind_quaternions(m);
    gsmap::bind_rasteriser(m);
    gsmap::bind_rays(m);
    gsmap::bind_sift(m);
    gsmap::bind_signatures(m);
    gsmap::bind_stopping(m);
    gsmap::bind_surroundings(m);
    gsmap::bind_surface(m);
}
