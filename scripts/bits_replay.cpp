// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Repeats the calls of a trace (format: bits_trace.py) with a library of another build, and reports the first call with
// different bits. Usage: bits_replay LIBRARY TRACE. Exit status 1 for a difference, 2 for bad input.

#include <dlfcn.h>

#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <deque>
#include <fstream>
#include <map>
#include <string>
#include <vector>

namespace {

using Word = std::int64_t;
/// Integers and doubles are passed in separate registers, and a function ignores the registers that it does not use.
/// Therefore one type can call every function.
using Function = Word (*)(Word, Word, Word, Word, Word, Word, Word, Word, Word, Word, double, double, double, double);

std::ifstream file;

void read(void* to, Word size) {
    if (!file.read(static_cast<char*>(to), size)) {
        std::fprintf(stderr, "the trace ends within a call\n");
        std::exit(2);
    }
}
template <class T = Word>
T take() {
    T value;
    read(&value, sizeof value);
    return value;
}

/// Memory argument of a call, and its content after the recorded call.
struct Memory {
    std::vector<double> now;
    const std::vector<char>* after;
    Word size;
};
std::deque<Memory> memories;
std::deque<std::vector<char>> contents;

const std::vector<char>& content(Word size) {
    const Word number = take();
    if (number == static_cast<Word>(contents.size())) read(contents.emplace_back(size).data(), size);
    return contents.at(number);
}

Word memory() {
    Memory& m = memories.emplace_back();
    m.size = take();
    m.now.resize(m.size / 8 + 1);
    std::memcpy(m.now.data(), content(m.size).data(), m.size);
    m.after = &content(m.size);
    return reinterpret_cast<Word>(m.now.data());
}

/// Describes the first differing number of the call's memory; empty without a difference.
std::string difference() {
    int which = 0;
    for (const Memory& m : memories) {
        ++which;
        if (m.size == 0 || std::memcmp(m.now.data(), m.after->data(), m.size) == 0) continue;
        for (Word k = 0; k < m.size / 8; ++k) {
            double was;
            std::memcpy(&was, m.after->data() + 8 * k, 8);
            if (std::memcmp(&was, &m.now[k], 8) == 0) continue;
            char text[200];
            std::snprintf(text, sizeof text, "number %lld of array %d: %a was recorded, %a came out",
                          static_cast<long long>(k), which, was, m.now[k]);
            return text;
        }
    }
    return {};
}

}  // namespace

int main(int count, char** arguments) {
    if (count != 3) {
        std::fprintf(stderr, "usage: %s LIBRARY TRACE\n", arguments[0]);
        return 2;
    }
    void* const library = dlopen(arguments[1], RTLD_NOW);
    if (!library) {
        std::fprintf(stderr, "%s\n", dlerror());
        return 2;
    }
    file.open(arguments[2], std::ios::binary);
    std::map<Word, Word> plans;
    std::map<std::string, long> calls;
    long total = 0;
    while (file.peek() != std::ifstream::traits_type::eof()) {
        std::string name(take(), ' ');
        read(name.data(), static_cast<Word>(name.size()));
        const char returned = take<char>();
        const Word result = take(), size = take();
        Word words[10] = {};
        double numbers[4] = {};
        int word = 0, number = 0;
        memories.clear();
        std::vector<Word> several, request;
        for (Word k = 0; k < size; ++k) {
            switch (take<char>()) {
                case 'h': words[word++] = plans.at(take()); break;
                case 'i': words[word++] = take(); break;
                case 'd': numbers[number++] = take<double>(); break;
                case '0': words[word++] = 0; break;
                case 'b': words[word++] = memory(); break;
                case 'a':
                    several.resize(take());
                    for (Word& place : several) {
                        take<char>();
                        place = memory();
                    }
                    words[word++] = reinterpret_cast<Word>(several.data());
                    break;
                case 'f':
                    request.resize(take() / 8);
                    read(request.data(), static_cast<Word>(8 * request.size()));
                    for (Word at = take(); at >= 0; at = take()) {
                        take<char>();
                        request[at] = memory();
                    }
                    words[word++] = reinterpret_cast<Word>(request.data());
                    break;
                default: std::fprintf(stderr, "%s has an argument of unknown kind\n", name.c_str()); return 2;
            }
        }
        void* const found = dlsym(library, name.c_str());
        if (!found) {
            std::fprintf(stderr, "the library has no %s\n", name.c_str());
            return 2;
        }
        const Word* const w = words;
        const Word came = reinterpret_cast<Function>(found)(w[0], w[1], w[2], w[3], w[4], w[5], w[6], w[7], w[8], w[9],
                                                            numbers[0], numbers[1], numbers[2], numbers[3]);
        ++total;
        ++calls[name];
        if (returned == 'h') plans[result] = came;
        const bool status = returned == 'i' && static_cast<std::int32_t>(came) != static_cast<std::int32_t>(result);
        std::string fault = difference();
        if (status || (returned == 'n' && came != result)) fault = "another number is returned";
        if (!fault.empty()) {
            std::printf("call %ld, of %s: %s\n", total, name.c_str(), fault.c_str());
            return 1;
        }
    }
    std::printf("%ld calls of %zu functions\n", total, calls.size());
    return 0;
}
