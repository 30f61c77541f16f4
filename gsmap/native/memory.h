// Memory for many values at once.
#pragma once
#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <new>
#include <vector>

#ifdef __linux__
#include <sys/mman.h>
#endif

namespace gsmap {

// Room for so many bytes, to be freed; in large pages where the system has them: a page is cleared when it is first
// touched, and 4 kB at a time that costs more than much that is done with them. As numpy does.
inline void *roomy(std::size_t bytes) {
    constexpr std::size_t kLine = 64, kPage = 4096, kMany = std::size_t(1) << 22;
    void *out = std::aligned_alloc(kLine, (bytes + kLine - 1) / kLine * kLine);
    if (!out) throw std::bad_alloc();
#if defined(__linux__) && defined(MADV_HUGEPAGE)
    if (bytes >= kMany) {
        const std::size_t begin = (reinterpret_cast<std::uintptr_t>(out) + kPage - 1) / kPage * kPage;
        const std::size_t end = (reinterpret_cast<std::uintptr_t>(out) + bytes) / kPage * kPage;
        madvise(reinterpret_cast<void *>(begin), end - begin, MADV_HUGEPAGE);  // a hint: it may be refused
    }
#endif
    return out;
}

template <class T> struct Roomy {
    using value_type = T;
    Roomy() = default;
    template <class Other> Roomy(const Roomy<Other> &) {}
    T *allocate(std::size_t count) {
        if (count > PTRDIFF_MAX / sizeof(T)) throw std::bad_array_new_length();
        return static_cast<T *>(roomy(count * sizeof(T)));
    }
    void deallocate(T *at, std::size_t) { std::free(at); }
    bool operator==(const Roomy &) const { return true; }
    bool operator!=(const Roomy &) const { return false; }
};

// A vector of many.
template <class T> using Many = std::vector<T, Roomy<T>>;

}  // namespace gsmap
