// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Translation unit of listed elements: their force loops, and runs without a grid.

#include "mesh/run.hpp"

#include "mesh/forces.hpp"
#include "plan/runs.hpp"

namespace cloth::plan {

template <class T>
void add_forces(const List& list, Elements<T>& elements, const T* x, const T* v, T* f, PowerSums* powers, T* mass,
                T half_step) {
    mesh::with_law(list.kind, [&](auto law) {
        using Law = decltype(law);
        const auto add = [&](auto damped, auto record) {
            mesh::ForceLoop<Law, T, damped.value, record.value>(elements, list.common, x, v, f, powers, mass, half_step)
                .add();
        };
        constexpr std::true_type yes;
        constexpr std::false_type no;
        const bool damped = Law::absolute_velocities || list.damped;
        if (powers && damped)
            add(yes, yes);
        else if (damped)
            add(yes, no);
        else if constexpr (!Law::absolute_velocities)
            add(no, no);
    });
}
template void add_forces(const List&, Elements<float>&, const float*, const float*, float*, PowerSums*, float*, float);
template void add_forces(const List&, Elements<double>&, const double*, const double*, double*, PowerSums*, double*,
                         double);

template <class T>
RunStatus run_lists(Plan& plan, const Run& run) {
    return mesh::ListRun<T, false>(plan, run).execute();
}
template RunStatus run_lists<float>(Plan&, const Run&);
template RunStatus run_lists<double>(Plan&, const Run&);
RunStatus evaluate_lists(Plan& plan, const Run& run) { return mesh::ListRun<double, true>(plan, run).execute(); }

}  // namespace cloth::plan
