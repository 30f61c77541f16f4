// Bindings of the consistency graph and maximum clique kernels.
#pragma once
#include <nanobind/nanobind.h>

void bind_clique(nanobind::module_ &m);
