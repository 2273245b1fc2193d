// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// All laws of springs, membranes, hinges and panels.
#pragma once

#include "laws/added_mass.hpp"
#include "laws/bending_friction.hpp"
#include "laws/coupling.hpp"
#include "laws/hinge.hpp"
#include "laws/joint.hpp"
#include "laws/membrane.hpp"
#include "laws/panel.hpp"
#include "laws/quadratic.hpp"
#include "laws/spring.hpp"
