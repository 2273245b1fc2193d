// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Tables and partitions of a plan, made when a run first needs them. Definitions, for one translation unit.
#pragma once

#include "plan/plan.hpp"

namespace cloth::plan {

using contact::contact_block, mesh::Kind;

template <class T>
const GridTables<T>& Plan::grid_tables() {
    if constexpr (sizeof(T) == 8) {
        return tables;
    } else {
        if (single_tables.numbers.empty()) single_tables = GridTables<float>(*grid, inverse.data());
        return single_tables;
    }
}

void Plan::assign_lists() {
    if (slots.size() == lists.size()) return;
    std::vector<std::vector<std::int64_t>> list_slots(lists.size());
    bool hinges = false;
    for (std::size_t k = 0; grid && k < lists.size(); ++k) {
        if (lists[k].slow) list_slots[k] = row_slots<4>(*grid, lists[k]);
        hinges = hinges || !list_slots[k].empty();
    }
    for (std::size_t k = 0; hinges && k < lists.size(); ++k)
        if (lists[k].kind == Kind::spring) list_slots[k] = row_slots<2>(*grid, lists[k]);
    const auto first_cells = [&](Kind kind) -> std::int64_t {
        for (std::size_t k = 0; grid && k < lists.size(); ++k) {
            if (lists[k].kind != kind) continue;
            list_slots[k] = cell_slots(*grid, lists[k]);
            if (!list_slots[k].empty()) return static_cast<std::int64_t>(k);
        }
        return -1;
    };
    curvature_list = -1;
    for (std::size_t k = 0; grid && curvature_list < 0 && k < lists.size(); ++k) {
        if (lists[k].kind != Kind::quadratic) continue;
        list_slots[k] = grid::curvature_slots(*grid, lists[k]);
        if (!list_slots[k].empty()) curvature_list = static_cast<std::int64_t>(k);
    }
    air_list = first_cells(Kind::panel4);
    mass_list = first_cells(Kind::mass4);
    slots = std::move(list_slots);
    const auto in_order = [&](std::int64_t k) { return k >= 0 && grid::are_cells_in_order(*grid, lists[k], slots[k]); };
    air_in_order = in_order(air_list), mass_in_order = in_order(mass_list);
}

bool Plan::has_off_grid_lists() {
    assign_lists();
    for (std::size_t k = 0; k < lists.size(); ++k)
        if (slots[k].empty()) return true;
    return false;
}

bool Plan::has_fast_off_grid_lists() {
    assign_lists();
    for (std::size_t k = 0; k < lists.size(); ++k)
        if (slots[k].empty() && !lists[k].slow) return true;
    return false;
}

template <class T>
const Workspace<T>& Plan::workspace_with_tables() {
    Workspace<T>& first = workspace<T>();
    if (first.has_tables) return first;
    assign_lists();
    first.tables.clear();
    for (std::size_t k = 0; k < lists.size(); ++k)
        if (!slots[k].empty() && (lists[k].slow || lists[k].kind == Kind::spring))
            first.tables.emplace_back(*grid, lists[k], slots[k]);
    first.cells = air_list < 0 ? CellTable<T>() : CellTable<T>(*grid, slots[air_list]);
    first.mass_cells = mass_list < 0 ? CellTable<T>() : CellTable<T>(*grid, slots[mass_list]);
    first.curvature = curvature_list < 0 ? CurvatureTable<T>()
                                         : CurvatureTable<T>(*grid, lists[curvature_list], slots[curvature_list]);
    first.has_tables = true;
    return first;
}

template <class T>
std::vector<Partition<T>>& Plan::partitions(const std::vector<std::int64_t>& borders, bool multirate, int index) {
    auto& cached = workspace<T>(index).partitions[multirate][borders.size() > 2];
    bool is_current = cached.size() + 1 == borders.size();
    for (std::size_t k = 0; is_current && k < cached.size(); ++k)
        is_current =
            cached[k].first == borders[k] && cached[k].last == borders[k + 1] && cached[k].lists.size() == lists.size();
    if (is_current) return cached;
    assign_lists();
    // Stored once complete, because memory may run out.
    std::vector<Partition<T>> fresh(borders.size() - 1);
    for (std::size_t k = 0; k < fresh.size(); ++k) {
        Partition<T>& partition = fresh[k];
        partition.first = partition.low = borders[k];
        partition.last = partition.high = borders[k + 1];
        for (const List& list : lists) {
            partition.lists.emplace_back();
            // Impulses of multirate hinges need the mass of the air.
            if (!slots[partition.lists.size() - 1].empty() && !(multirate && (list.slow || is_mass(list.kind))))
                continue;
            partition.lists.back() = list.template select<T>(rank.data(), count, partition.first, partition.last);
            const Elements<T>& elements = partition.lists.back();
            for (int c = 0; c < list.width; ++c)
                for (const std::uint32_t corner : elements.corner[c]) {
                    if (corner / 4 == static_cast<std::uint64_t>(count)) continue;
                    partition.low = std::min<std::int64_t>(partition.low, corner / 4);
                    partition.high = std::max<std::int64_t>(partition.high, corner / 4 + 1);
                }
        }
        partition.f.assign(4 * (count + 1), T(0));
        if (has_added_mass()) partition.mass_blocks.assign(8 * (count + 1), T(0));
    }
    return cached = std::move(fresh);
}

std::vector<std::int64_t> Plan::even_borders(int threads) const {
    std::vector<double> work(count, 1.0);
    double total = static_cast<double>(count);
    for (const List& list : lists)
        for (std::int64_t corner : list.corners) {
            work[rank[corner]] += list.width;
            total += list.width;
        }
    std::vector<std::int64_t> borders{0};
    double done = 0.0;
    for (std::int64_t i = 0; i < count; ++i) {
        done += work[i];
        const auto next = static_cast<double>(borders.size());
        if (static_cast<int>(borders.size()) < threads && done >= total * next / threads) borders.push_back(i + 1);
    }
    while (static_cast<int>(borders.size()) <= threads) borders.push_back(count);
    if (contacts.count())
        for (std::int64_t& border : borders)
            border = std::min((border + contact_block / 2) / contact_block * contact_block, count);
    borders.back() = count;
    return borders;
}

template const GridTables<float>& Plan::grid_tables();
template const GridTables<double>& Plan::grid_tables();
template const Workspace<float>& Plan::workspace_with_tables();
template const Workspace<double>& Plan::workspace_with_tables();
template std::vector<Partition<float>>& Plan::partitions(const std::vector<std::int64_t>&, bool, int);
template std::vector<Partition<double>>& Plan::partitions(const std::vector<std::int64_t>&, bool, int);

}  // namespace cloth::plan
