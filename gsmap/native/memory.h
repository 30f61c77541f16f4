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

// Allocates for vectors: from the system directly where it is much, in large pages if there are any. A page is cleared when
// it is first touched, and 4 kB at a time that costs more than much that is done with them; and what is given back is gone.
template <class T> struct Roomy {
    using value_type = T;
    Roomy() = default;
    template <class Other> Roomy(const Roomy<Other> &) {}
    T *allocate(std::size_t count) {
        if (count > PTRDIFF_MAX / sizeof(T)) throw std::bad_array_new_length();
#if defined(__linux__) && defined(MADV_HUGEPAGE)
        if (count * sizeof(T) >= kMany) {
            void *out = mmap(nullptr, count * sizeof(T), PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
            if (out == MAP_FAILED) throw std::bad_alloc();
            madvise(out, count * sizeof(T), MADV_HUGEPAGE);  // a wish
            return static_cast<T *>(out);
        }
#endif
        return static_cast<T *>(::operator new(count * sizeof(T)));
    }
    void deallocate(T *at, std::size_t count) {
#if defined(__linux__) && defined(MADV_HUGEPAGE)
        if (count * sizeof(T) >= kMany) {
            munmap(at, count * sizeof(T));
            return;
        }
#endif
        ::operator delete(at);
    }
    bool operator==(const Roomy &) const { return true; }
    bool operator!=(const Roomy &) const { return false; }

  private:
    static constexpr std::size_t kMany = std::size_t(1) << 22;
};

// A vector of many.
template <class T> using Many = std::vector<T, Roomy<T>>;

}  // namespace gsmap
