// Bindings of the maximum clique.
#pragma once
#include <nanobind/nanobind.h>

void bind_clique(nanobind::module_ &m);
