// Copyright 2026 the cloth_sim_ros authors
// SPDX-License-Identifier: Apache-2.0
//
// Replays a trace of engine calls (see bits_trace.py) with a library of another build, and reports the first call whose
// results differ in a bit. Usage: bits_replay LIBRARY TRACE. Exit status 1 if a call differs, 2 for bad input.

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
/// The calling convention passes integers and doubles in separate registers, and a function ignores surplus arguments.
/// Therefore one type can call all functions.
using Function = Word (*)(Word, Word, Word, Word, Word, Word, Word, Word, Word, Word, Word, double, double, double,
                          double);

std::ifstream file;

void read(void* to, Word size) {
    if (!file.read(static_cast<char*>(to), size)) {
        std::fprintf(stderr, "the trace ends within a call\n");
        std::exit(2);
    }
}
template <class T = Word>
T read_value() {
    T value;
    read(&value, sizeof value);
    return value;
}

/// An array argument: its present content, and its content after the recorded call.
struct Memory {
    std::vector<double> now;
    const std::vector<char>* recorded;
    Word size;
};
std::deque<Memory> memories;
std::deque<std::vector<char>> contents;

const std::vector<char>& read_content(Word size) {
    const Word index = read_value();
    if (index == static_cast<Word>(contents.size())) read(contents.emplace_back(size).data(), size);
    return contents.at(index);
}

Word read_memory() {
    Memory& m = memories.emplace_back();
    m.size = read_value();
    m.now.resize(m.size / 8 + 1);
    std::memcpy(m.now.data(), read_content(m.size).data(), m.size);
    m.recorded = &read_content(m.size);
    return reinterpret_cast<Word>(m.now.data());
}

/// Description of the first number that differs in an array of the call; empty if none differs.
std::string difference() {
    int array = 0;
    for (const Memory& m : memories) {
        ++array;
        if (m.size == 0 || std::memcmp(m.now.data(), m.recorded->data(), m.size) == 0) continue;
        for (Word k = 0; k < m.size / 8; ++k) {
            double recorded;
            std::memcpy(&recorded, m.recorded->data() + 8 * k, 8);
            if (std::memcmp(&recorded, &m.now[k], 8) == 0) continue;
            char text[200];
            std::snprintf(text, sizeof text, "number %lld of array %d: %a was recorded, %a came out",
                          static_cast<long long>(k), array, recorded, m.now[k]);
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
        std::string name(read_value(), ' ');
        read(name.data(), static_cast<Word>(name.size()));
        const char returned = read_value<char>();
        const Word result = read_value(), size = read_value();
        Word words[11] = {};
        double numbers[4] = {};
        int n_words = 0, n_doubles = 0;
        memories.clear();
        std::vector<Word> pointers, request;
        for (Word k = 0; k < size; ++k) {
            switch (read_value<char>()) {
                case 'h': words[n_words++] = plans.at(read_value()); break;
                case 'i': words[n_words++] = read_value(); break;
                case 'd': numbers[n_doubles++] = read_value<double>(); break;
                case '0': words[n_words++] = 0; break;
                case 'b': words[n_words++] = read_memory(); break;
                case 'a':
                    pointers.resize(read_value());
                    for (Word& pointer : pointers) {
                        read_value<char>();
                        pointer = read_memory();
                    }
                    words[n_words++] = reinterpret_cast<Word>(pointers.data());
                    break;
                case 'f':
                    request.resize(read_value() / 8);
                    read(request.data(), static_cast<Word>(8 * request.size()));
                    for (Word at = read_value(); at >= 0; at = read_value()) {
                        read_value<char>();
                        request[at] = read_memory();
                    }
                    words[n_words++] = reinterpret_cast<Word>(request.data());
                    break;
                default: std::fprintf(stderr, "%s has an argument of unknown kind\n", name.c_str()); return 2;
            }
        }
        void* const symbol = dlsym(library, name.c_str());
        if (!symbol) {
            std::fprintf(stderr, "the library has no %s\n", name.c_str());
            return 2;
        }
        const Word* const w = words;
        const Word returned_value =
            reinterpret_cast<Function>(symbol)(w[0], w[1], w[2], w[3], w[4], w[5], w[6], w[7], w[8], w[9], w[10],
                                               numbers[0], numbers[1], numbers[2], numbers[3]);
        ++total;
        ++calls[name];
        if (returned == 'h') plans[result] = returned_value;
        const bool status =
            returned == 'i' && static_cast<std::int32_t>(returned_value) != static_cast<std::int32_t>(result);
        std::string message = difference();
        if (status || (returned == 'n' && returned_value != result)) message = "another number is returned";
        if (!message.empty()) {
            std::printf("call %ld, of %s: %s\n", total, name.c_str(), message.c_str());
            return 1;
        }
    }
    std::printf("%ld calls of %zu functions\n", total, calls.size());
    return 0;
}
